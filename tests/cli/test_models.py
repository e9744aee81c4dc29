"""Tests of ``mpsfm models``."""

from __future__ import annotations

import hashlib
import json
import os
import threading
from collections.abc import Callable, Iterator
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest
from typer.testing import CliRunner

from mpsfm_core.cli import build_app
from mpsfm_core.providers.weights import OFFLINE_VARIABLES

CONTENT = b"weights of a network"
SHA256 = hashlib.sha256(CONTENT).hexdigest()

PLUGIN = """
    from mpsfm_core import ProviderSpec, WeightsFile, hookimpl
    @hookimpl
    def mpsfm_providers():
        files = (WeightsFile("{uri}", "{sha256}", "MIT"),)
        return [ProviderSpec("depth", "tiny-depth", "json:loads", weights=files)]
"""


def models(*arguments: str) -> tuple[int, str, str]:
    """Run ``mpsfm models ...``; return exit code, stdout and stderr."""
    result = CliRunner().invoke(build_app(), ["models", *arguments])
    return result.exit_code, result.stdout, result.stderr


class _Quiet(SimpleHTTPRequestHandler):
    def log_message(self, *args: object) -> None:
        pass


@pytest.fixture
def uri(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """A weights file on a server, and an empty cache."""
    monkeypatch.setenv("MPSFM_CACHE", str(tmp_path / "cache"))
    for name in OFFLINE_VARIABLES:
        monkeypatch.delenv(name, raising=False)
    folder = tmp_path / "served"
    folder.mkdir()
    (folder / "tiny.onnx").write_bytes(CONTENT)
    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(_Quiet, directory=str(folder)))
    thread = threading.Thread(target=server.serve_forever, args=(0.01,))
    thread.start()
    yield f"http://127.0.0.1:{server.server_port}/tiny.onnx"
    server.shutdown()
    thread.join()
    server.server_close()


def test_models_list_fetch_verify(uri: str, install_plugin: Callable[..., str]) -> None:
    install_plugin("mpsfm-tiny", PLUGIN.format(uri=uri, sha256=SHA256))
    assert "to be downloaded" in _line(models("list")[1], "depth/tiny-depth")
    code, _, message = models("path", "tiny-depth")
    assert code == 2 and "mpsfm models fetch" in message

    code, out, message = models("fetch", "tiny-depth")
    assert message.startswith(f"license of {uri}: MIT\n")
    path = Path(out.strip())
    assert code == 0 and path.read_bytes() == CONTENT
    assert models("path", "depth/tiny-depth")[1].strip() == str(path)
    assert "local" in _line(models("list")[1], "depth/tiny-depth")
    (entry,) = [e for e in json.loads(models("list", "--json")[1]) if e["uri"] == uri]
    assert entry["path"] == str(path) and entry["license"] == "MIT"
    assert f"{SHA256}  {uri}" in models("verify")[1]

    path.write_bytes(b"damaged")
    code, _, message = models("verify", "tiny-depth")
    assert code == 2 and f"expected {SHA256}" in message


def _line(table: str, name: str) -> str:
    (line,) = [line for line in table.splitlines() if name in line]
    return line


def test_fetch_uri_with_given_hash(uri: str, tmp_path: Path) -> None:
    other = tmp_path / "other"
    code, out, _ = models("fetch", uri, "--sha256", SHA256, "--cache", str(other))
    assert code == 0 and Path(out.strip()).is_relative_to(other)
    code, _, message = models("fetch", uri, "--sha256", "0" * 64)
    assert code == 2 and "expected 0000" in message


def test_fetch_offline_fails(
    uri: str, install_plugin: Callable[..., str], monkeypatch: pytest.MonkeyPatch
) -> None:
    install_plugin("mpsfm-tiny", PLUGIN.format(uri=uri, sha256=SHA256))
    monkeypatch.setenv("MPSFM_OFFLINE", "1")
    code, out, message = models("fetch", "tiny-depth")
    assert (code, out) == (2, "") and "downloads are switched off" in message
    assert "to be downloaded" in _line(models("list")[1], "depth/tiny-depth")


def test_fetch_unknown_name_suggests_closest(uri: str, install_plugin: Callable[..., str]) -> None:
    install_plugin("mpsfm-tiny", PLUGIN.format(uri=uri, sha256=SHA256))
    code, _, message = models("fetch", "tiny-dept")
    assert code == 2 and "did you mean 'tiny-depth'" in message


CONFIG = """
extends: fast-cpu
features: {{use: sift}}
matcher: {{use: mutual-nearest}}
depth: {{use: {name}}}
normals: {{use: from-depth}}
"""


def test_fetch_configuration_downloads_all_weights(
    uri: str, tmp_path: Path, install_plugin: Callable[..., str]
) -> None:
    install_plugin("mpsfm-tiny", PLUGIN.format(uri=uri, sha256=SHA256))
    config = tmp_path / "mine.yaml"
    config.write_text(CONFIG.format(name="tiny-depth"))
    code, out, message = models("fetch", str(config))
    assert code == 0 and Path(out.strip()).read_bytes() == CONTENT
    assert message.splitlines()[:2] == [f"license of {uri}: MIT", "to be downloaded: 0 MB"]
    assert "to be downloaded" not in models("fetch", str(config))[2]


def test_fetch_noncommercial_weights_needs_acceptance(
    uri: str, install_plugin: Callable[..., str]
) -> None:
    plugin = PLUGIN.replace('"MIT"', '"CC-BY-NC-4.0"').format(uri=uri, sha256=SHA256)
    install_plugin("mpsfm-tiny", plugin)
    code, out, message = models("fetch", "tiny-depth")
    assert (code, out) == (2, "")
    assert "not for commercial use (CC-BY-NC-4.0)" in message and "--accept tiny-depth" in message
    assert models("fetch", "tiny-depth", "--accept", "another")[0] == 2
    assert models("fetch", "tiny-depth", "--accept", "tiny-depth")[0] == 0
    assert models("fetch", "tiny-depth")[0] == 0, "it is here: nothing is left to accept"


def test_export_writes_unpublished_network(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MPSFM_EXPORTS", str(tmp_path))
    code, _, message = models("fetch", "export:dsine")
    assert code == 2 and "mpsfm models export dsine --code CHECKOUT" in " ".join(message.split())
    (tmp_path / "elsewhere.onnx").write_bytes(CONTENT)
    (tmp_path / "dsine.json").write_text(json.dumps({"file": str(tmp_path / "elsewhere.onnx")}))
    assert models("path", "export:dsine")[1].strip() == str(tmp_path / "elsewhere.onnx")


def test_fetch_local_file_prints_path(uri: str, tmp_path: Path) -> None:
    path = tmp_path / "served" / "tiny.onnx"
    assert models("path", str(path))[1].strip() == str(path)
    assert models("verify", os.fspath(path))[1].startswith(SHA256)
