"""Tests of the weight store against a local file server."""

from __future__ import annotations

import hashlib
import os
import pickle
import socket
import subprocess
import sys
import threading
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from mpsfm_core.data.errors import WeightsError
from mpsfm_core.providers import weights
from mpsfm_core.providers.weights import WeightStore, file_sha256, load_torch_state
from tests.support.file_server import Server, serving

CONTENT = np.random.default_rng(5).bytes(300_000)
SHA256 = hashlib.sha256(CONTENT).hexdigest()


@pytest.fixture
def server() -> Iterator[Server]:
    with serving() as server:
        server.files["/v1/model.onnx"] = CONTENT
        yield server


@pytest.fixture(autouse=True)
def no_waiting(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(weights, "_RETRY_WAIT_S", 0.001)
    for name in ("MPSFM_CACHE", *weights.OFFLINE_VARIABLES):
        monkeypatch.delenv(name, raising=False)


@pytest.fixture
def uri(server: Server) -> str:
    return f"{server.url}/v1/model.onnx"


def leftovers(store: WeightStore) -> list[str]:
    return [p.name for p in store.cache_dir.rglob("*") if ".part" in p.name or ".tmp" in p.name]


def test_weights_are_downloaded_once(tmp_path: Path, server: Server, uri: str) -> None:
    seen = []
    store = WeightStore(tmp_path, progress=lambda *args: seen.append(args))
    path = store.resolve(uri, SHA256.upper())
    assert path.read_bytes() == CONTENT and path.name == "model.onnx"
    assert store.resolve(uri, SHA256) == store.resolve(uri) == path
    assert len(server.requests) == 1
    assert seen[-1] == ("model.onnx", len(CONTENT), len(CONTENT))
    assert leftovers(store) == []


@pytest.mark.parametrize("sha256", [SHA256, None])
def test_cut_connections_are_resumed(
    tmp_path: Path, server: Server, uri: str, sha256: str | None
) -> None:
    server.cut_after = 110_000
    path = WeightStore(tmp_path).resolve(uri, sha256)
    assert path.read_bytes() == CONTENT
    assert server.ranges() == [None, "bytes=110000-", "bytes=220000-"]


def test_resumes_in_the_next_run(tmp_path: Path, server: Server, uri: str) -> None:
    server.cut_after = 0
    part = _partial(tmp_path, server, uri)
    assert part.read_bytes() == CONTENT[:1000]
    server.cut_after, server.requests[:] = None, []
    assert WeightStore(tmp_path).resolve(uri).read_bytes() == CONTENT
    assert server.ranges() == ["bytes=1000-"]


def _partial(cache: Path, server: Server, uri: str) -> Path:
    """Leave 1000 bytes of a partial download, as a killed process does."""
    server.cut_after = 0
    with pytest.raises(WeightsError, match="continues after"):
        WeightStore(cache).resolve(uri)
    (part,) = cache.rglob("*.part")
    part.write_bytes(CONTENT[:1000])
    return part


def test_file_that_changed_on_the_server_is_not_patched_together(
    tmp_path: Path, server: Server, uri: str
) -> None:
    _partial(tmp_path, server, uri)
    other = bytes(reversed(CONTENT))
    server.files["/v1/model.onnx"], server.etag, server.cut_after = other, '"v2"', None
    assert WeightStore(tmp_path).resolve(uri).read_bytes() == other


def test_without_a_version_or_hash_it_starts_again(
    tmp_path: Path, server: Server, uri: str
) -> None:
    server.etag = None
    _partial(tmp_path, server, uri)
    server.cut_after, server.requests[:] = None, []
    assert WeightStore(tmp_path).resolve(uri).read_bytes() == CONTENT
    assert server.ranges() == [None]


def test_killed_between_download_and_move(tmp_path: Path, server: Server, uri: str) -> None:
    part = _partial(tmp_path, server, uri)
    part.write_bytes(CONTENT)
    server.cut_after = None
    assert WeightStore(tmp_path).resolve(uri).read_bytes() == CONTENT
    part = tmp_path.joinpath("weights").rglob("*.part")
    assert not list(part)


def test_partial_file_longer_than_the_file(tmp_path: Path, server: Server, uri: str) -> None:
    _partial(tmp_path, server, uri).write_bytes(CONTENT + b"more")
    server.cut_after = None
    assert WeightStore(tmp_path).resolve(uri).read_bytes() == CONTENT


def test_wrong_hash_leaves_nothing_behind(tmp_path: Path, server: Server, uri: str) -> None:
    store = WeightStore(tmp_path)
    with pytest.raises(WeightsError, match=f"SHA-256 {SHA256}, expected {'0' * 64}"):
        store.resolve(uri, "0" * 64)
    assert store.locate(uri) is None and leftovers(store) == []
    assert store.resolve(uri, SHA256).read_bytes() == CONTENT


def test_hash_of_the_first_download_is_kept(tmp_path: Path, server: Server, uri: str) -> None:
    path = WeightStore(tmp_path).resolve(uri)
    path.unlink()
    server.files["/v1/model.onnx"] = b"somebody else's model"
    with pytest.raises(WeightsError, match=f"expected {SHA256}"):
        WeightStore(tmp_path).resolve(uri)


def test_damaged_file_is_fetched_again(tmp_path: Path, server: Server, uri: str) -> None:
    path = WeightStore(tmp_path).resolve(uri)
    path.write_bytes(CONTENT[:-1])
    with pytest.raises(WeightsError, match="is damaged in the cache"):
        WeightStore(tmp_path, offline=True).resolve(uri)
    assert WeightStore(tmp_path).resolve(uri).read_bytes() == CONTENT


def test_touched_but_intact_file_is_not_fetched_again(
    tmp_path: Path, server: Server, uri: str
) -> None:
    path = WeightStore(tmp_path).resolve(uri)
    os.utime(path, (1, 1))
    assert WeightStore(tmp_path, offline=True).resolve(uri) == path
    assert len(server.requests) == 1


@pytest.mark.parametrize(("status", "requests"), [(404, 1), (403, 1), (503, 4)])
def test_server_errors_raise(
    tmp_path: Path, server: Server, uri: str, status: int, requests: int
) -> None:
    server.status = status
    with pytest.raises(WeightsError, match=str(status)) as caught:
        WeightStore(tmp_path).resolve(uri)
    assert uri in str(caught.value)
    assert len(server.requests) == requests


def test_no_server_is_found_out_with_one_attempt(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(weights, "_RETRY_WAIT_S", 3600)
    with pytest.raises(WeightsError, match=r"cannot be downloaded.*local file"):
        WeightStore(tmp_path).resolve("http://127.0.0.1:9/model.onnx")


def test_server_that_does_not_answer_raises(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(weights, "_CONNECT_TIMEOUT_S", 0.05)
    monkeypatch.setattr(weights, "_RETRY_WAIT_S", 3600)
    with socket.create_server(("127.0.0.1", 0)) as silent:
        uri = f"http://127.0.0.1:{silent.getsockname()[1]}/model.onnx"
        with pytest.raises(WeightsError, match=r"no answer from server 127\.0\.0\.1"):
            WeightStore(tmp_path).resolve(uri)


def test_resolve_offline_raises(
    tmp_path: Path, server: Server, uri: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MPSFM_OFFLINE", "1")
    with pytest.raises(WeightsError, match=r"switched off.*mpsfm models fetch"):
        WeightStore(tmp_path).resolve(uri)
    assert server.requests == []
    path = WeightStore(tmp_path, offline=False).resolve(uri)
    assert WeightStore(tmp_path).resolve(uri) == path


def test_concurrent_processes_fetch_once(tmp_path: Path, server: Server, uri: str) -> None:
    code = "import sys; from mpsfm_core.providers.weights import WeightStore as S; "
    code += "print(S(sys.argv[1]).resolve(sys.argv[2], sys.argv[3]))"
    command = [sys.executable, "-c", code, str(tmp_path), uri, SHA256]
    jobs = [subprocess.Popen(command, stdout=subprocess.PIPE, text=True) for _ in range(4)]
    paths = {job.communicate(timeout=60)[0] for job in jobs}
    assert [job.returncode for job in jobs] == [0] * 4
    assert len(paths) == 1
    assert len(server.requests) == 1


def test_threads_fetch_different_files_and_record_all(tmp_path: Path, server: Server) -> None:
    for number in range(8):
        server.files[f"/v1/{number}.bin"] = bytes([number]) * 50_000
    uris = [f"{server.url}/v1/{number}.bin" for number in range(8)]
    store = WeightStore(tmp_path)
    threads = [threading.Thread(target=store.resolve, args=(uri,)) for uri in uris]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    offline = WeightStore(tmp_path, offline=True)
    assert [offline.resolve(uri).read_bytes()[0] for uri in uris] == list(range(8))
    assert [len(offline.verify(uri)) for uri in uris] == [64] * 8


def test_companions_lie_side_by_side(tmp_path: Path, server: Server, uri: str) -> None:
    server.files["/v1/model.onnx_data"] = b"data"
    server.files["/v2/model.onnx"] = b"other"
    store = WeightStore(tmp_path)
    path = store.resolve(uri)
    assert store.resolve(f"{uri}_data") == path.with_name("model.onnx_data")
    assert store.resolve(f"{server.url}/v2/model.onnx").parent != path.parent


def test_hub_file_is_downloaded_at_pinned_revision(
    tmp_path: Path, server: Server, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Check the pinned revision, and that the user's token is not sent to the host of a
    redirect."""
    monkeypatch.setattr("huggingface_hub.constants.ENDPOINT", server.url)
    template = server.url + "/{repo_id}/resolve/{revision}/{filename}"
    monkeypatch.setattr("huggingface_hub.constants.HUGGINGFACE_CO_URL_TEMPLATE", template)
    monkeypatch.setenv("HF_TOKEN", "hf_secret")
    server.redirects["/org/repo/resolve/0a1b2c/onnx/m%20b.onnx"] = f"{server.url}/v1/model.onnx"
    path = WeightStore(tmp_path).resolve("hf://org/repo@0a1b2c/onnx/m b.onnx", SHA256)
    assert path.read_bytes() == CONTENT
    (first, headers), (second, others) = server.requests
    assert first == "/org/repo/resolve/0a1b2c/onnx/m%20b.onnx"
    assert headers["Authorization"] == "Bearer hf_secret"
    assert second == "/v1/model.onnx" and "Authorization" not in others


@pytest.mark.parametrize(
    ("uri", "message"),
    [
        ("hf://org/repo/model.onnx", "REVISION"),
        ("http://example.org/model.onnx", "plain http needs a sha256"),
        ("ftp://example.org/model.onnx", "unknown scheme"),
        ("package:numpy", "package:NAME/PATH"),
        ("package:numpy/../secret", "package:NAME/PATH"),
        ("package:not_there_at_all/x.pt", "pip install --no-deps not-there-at-all"),
        ("package:numpy/x.pt", "does not exist"),
        ("nowhere/model.onnx", "does not exist"),
    ],
)
def test_uris_that_cannot_be(tmp_path: Path, uri: str, message: str) -> None:
    store = WeightStore(tmp_path)
    with pytest.raises(WeightsError, match=message) as caught:
        store.resolve(uri)
    assert uri in str(caught.value)
    assert store.locate(uri) is None


def test_local_files_are_resolved(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "my model.onnx"
    path.write_bytes(CONTENT)
    store = WeightStore(tmp_path / "cache")
    monkeypatch.setenv("HOME", str(tmp_path))
    for uri in (str(path), path.as_uri(), "~/my model.onnx"):
        assert store.resolve(uri, SHA256) == path
    with pytest.raises(WeightsError, match="expected"):
        store.resolve(str(path), "1" * 64)
    with pytest.raises(WeightsError, match="64 hexadecimal"):
        store.resolve(str(path), "abc")
    assert not (tmp_path / "cache").exists()


def test_package_resource_without_import(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    package = tmp_path / "weights_only_package"
    (package / "data").mkdir(parents=True)
    (package / "__init__.py").write_text("raise RuntimeError('must not be imported')")
    (package / "data" / "w.pt").write_bytes(b"w")
    monkeypatch.syspath_prepend(tmp_path)
    path = WeightStore(tmp_path).resolve("package:weights_only_package/data/w.pt")
    assert path == package / "data" / "w.pt"


def test_verify_detects_changed_weights(tmp_path: Path, server: Server, uri: str) -> None:
    store = WeightStore(tmp_path)
    with pytest.raises(WeightsError, match="not on this machine"):
        store.verify(uri)
    path = store.resolve(uri)
    assert store.verify(uri) == store.verify(uri, SHA256) == SHA256
    path.write_bytes(b"changed")
    with pytest.raises(WeightsError, match=file_sha256(path)):
        store.verify(uri)


def test_cache_by_environment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MPSFM_CACHE", str(tmp_path / "elsewhere"))
    assert WeightStore().cache_dir.is_relative_to(tmp_path / "elsewhere")
    assert WeightStore(tmp_path / "here").cache_dir.is_relative_to(tmp_path / "here")


def test_cache_below_a_file(tmp_path: Path, server: Server, uri: str) -> None:
    (tmp_path / "file").write_bytes(b"")
    with pytest.raises(WeightsError, match=r"cannot store .* in the cache folder"):
        WeightStore(tmp_path / "file").resolve(uri)


class Evil:
    """Create a file when unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[object, tuple[str, int]]:
        return os.open, (str(self.path), os.O_CREAT)


def test_tensors_without_running_code(tmp_path: Path) -> None:
    torch = pytest.importorskip("torch")
    good, evil = tmp_path / "good.pt", tmp_path / "evil.pt"
    torch.save({"state_dict": {"a": torch.arange(3.0)}}, good)
    torch.save({"a": Evil(tmp_path / "created")}, evil)
    assert load_torch_state(good)["state_dict"]["a"].tolist() == [0, 1, 2]
    with pytest.raises(WeightsError, match="never executed"):
        load_torch_state(evil)
    evil.write_bytes(pickle.dumps(Evil(tmp_path / "created")))
    with pytest.raises(WeightsError, match="never executed"):
        load_torch_state(evil)
    assert not (tmp_path / "created").exists()


def test_safetensors_and_files_without_tensors(tmp_path: Path) -> None:
    torch = pytest.importorskip("torch")
    safetensors = pytest.importorskip("safetensors.torch")
    path = tmp_path / "m.safetensors"
    safetensors.save_file({"a": torch.ones(2)}, path)
    assert load_torch_state(path)["a"].tolist() == [1, 1]
    path.write_bytes(b"rubbish")
    with pytest.raises(WeightsError, match="damaged"):
        load_torch_state(path)
    torch.save(torch.ones(2), tmp_path / "t.pt")
    with pytest.raises(WeightsError, match="contains a Tensor"):
        load_torch_state(tmp_path / "t.pt")


class Answer:
    """Response with the fields that a redirect handler reads."""

    def read(self) -> bytes:
        return b""

    def close(self) -> None:
        pass


@pytest.mark.parametrize(
    ("asked", "target", "host_may_change", "why"),
    [
        ("https://8.8.8.8/a", "https://127.0.0.1/b", True, "local network"),
        ("https://8.8.8.8/a", "https://localhost:99/b", True, "local network"),
        ("https://8.8.8.8/a", "https://10.1.2.3/b", True, "local network"),
        ("https://8.8.8.8/a", "https://[::1]/b", True, "local network"),
        ("https://8.8.8.8/a", "https://169.254.169.254/latest", True, "local network"),
        ("https://8.8.8.8/a", "http://8.8.8.8/b", True, "without encryption"),
        ("https://8.8.8.8/a", "https://9.9.9.9/b", False, "another host"),
        ("https://8.8.8.8/a", "https://9.9.9.9/b", True, ""),
        ("https://8.8.8.8/a", "https://8.8.8.8/b", False, ""),
        ("http://127.0.0.1:1/a", "http://127.0.0.1:2/b", False, ""),
    ],
)
def test_where_a_server_may_redirect_to(
    asked: str, target: str, host_may_change: bool, why: str
) -> None:
    request = urllib.request.Request(asked)
    redirects = weights._RedirectPolicy(request, host_may_change)
    if why:
        with pytest.raises(WeightsError, match=why):
            redirects.redirect_request(request, Answer(), 302, "Found", {}, target)
    else:
        followed = redirects.redirect_request(request, Answer(), 302, "Found", {}, target)
        assert followed is not None and followed.full_url == target


def test_damaged_hash_record_raises(tmp_path: Path) -> None:
    store = WeightStore(tmp_path)
    store.cache_dir.mkdir()
    (store.cache_dir / "hashes.json").write_text("{")
    with pytest.raises(WeightsError, match=r"hashes\.json is damaged"):
        store.resolve("https://example.org/a.onnx")
