"""Tests that providers and weights are resolved before the first photo is decoded."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from mpsfm_core import Options, ProviderSpec, WeightsFile, hookimpl
from mpsfm_core.cli import build_app
from mpsfm_core.config import Config, load_config
from mpsfm_core.data import DepthPrior, NormalPrior, PinholeCamera, View
from mpsfm_core.data.errors import InputError
from mpsfm_core.pipeline.provider_resolution import (
    ProviderResolution,
    preview_providers,
    resolve_providers,
)
from mpsfm_core.pipeline.run import reconstruct
from mpsfm_core.providers import ProviderContext, weights, weights_from_option
from mpsfm_core.providers.builtin import plugin as builtin
from mpsfm_core.providers.registry import Registry
from mpsfm_core.testing.synthetic.scenes import arc_poses, room_scene
from tests.support.file_server import Server, serving

CAMERA = PinholeCamera(320, 240, 280.0, 280.0, 160.0, 120.0)
COUNT = 3
CONTENT = np.random.default_rng(3).bytes(200_000)
SHA256 = hashlib.sha256(CONTENT).hexdigest()


class Room:
    """Photos of a synthetic room with ground-truth depth and normals."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        scene, poses = room_scene(), arc_poses(COUNT, 12.0)
        renderings = [scene.render(CAMERA, pose) for pose in poses]
        self.depth = {f"{n}.png": r.depth for n, r in enumerate(renderings)}
        self.normals = {f"{n}.png": r.normals for n, r in enumerate(renderings)}
        folder.mkdir()
        for number, rendering in enumerate(renderings):
            bgr = cv2.cvtColor(rendering.rgb, cv2.COLOR_RGB2BGR)
            cv2.imwrite(str(folder / f"{number}.png"), bgr)

    @property
    def intrinsics(self) -> Path:
        path = self.folder.with_suffix(".yaml")
        path.write_text("1: {params: [280, 280, 160, 120], images: all}\n")
        return path


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Room:
    return Room(tmp_path_factory.mktemp("provision") / "photos")


class Network:
    """Fake network that returns ground truth by photo name."""

    room: Room

    def __init__(self, options: Options | None, context: ProviderContext) -> None:
        pass

    def predict(self, view: View, depth: DepthPrior | None = None) -> DepthPrior | NormalPrior:
        return DepthPrior.from_arrays(self.room.depth[view.name])

    def predict_joint(self, view: View) -> tuple[DepthPrior, NormalPrior]:
        normals = NormalPrior.from_arrays(self.room.normals[view.name], camera=view.camera)
        return DepthPrior.from_arrays(self.room.depth[view.name]), normals


class NamedOptions(Options):
    model: str
    sha256: str | None = None


def networks(room: Room, url: str, sha256: str | None = SHA256) -> Registry:
    """Registry of the core, a fake network with weights on a server, and one with local weights."""
    Network.room = room
    registry = Registry()
    registry.register(builtin, name="builtin", distribution="mpsfm-core", version="1")
    for kind in ("depth", "normals"):
        joint = frozenset({"joint-normals", "metric"} if kind == "depth" else ())
        strong = WeightsFile(f"{url}/strong.onnx", sha256, "MIT", len(CONTENT))
        common: dict[str, Any] = {"factory": Network, "capabilities": joint}
        registry.add(
            ProviderSpec(kind, "strong", weights=(strong,), accuracy="published", **common),
            ProviderSpec(kind, "compact", accuracy="measured", **common),
        )
    return registry


@pytest.fixture
def server(monkeypatch: pytest.MonkeyPatch) -> Iterator[Server]:
    monkeypatch.setattr(weights, "_RETRY_WAIT_S", 0.001)
    for name in weights.OFFLINE_VARIABLES:
        monkeypatch.delenv(name, raising=False)
    with serving() as server:
        server.files["/strong.onnx"] = CONTENT
        yield server


Configured = Callable[..., Config]


@pytest.fixture
def configured(tmp_path: Path) -> Configured:
    """Default configuration with the fake network ``strong`` as first choice."""
    path = tmp_path / "run.yaml"
    path.write_text("extends: default\ndepth: {use: strong, fallback: [compact, flat]}\n")

    def load(registry: Registry, *overrides: str) -> Config:
        settings = (f"runtime.cache_dir={tmp_path / 'cache'}", "runtime.workers=1", *overrides)
        return load_config(path, settings, registry)

    return load


def names(provision: ProviderResolution) -> list[str]:
    """Return the names of the resolved providers, without those of the fast pass."""
    return [c.provider.name for c in provision.choices if not c.block.startswith("fast_pass.")]


class Listener:
    """Records the messages and download steps of a run."""

    def __init__(self) -> None:
        self.notices: list[str] = []
        self.progress: list[tuple[str, int, int]] = []

    @hookimpl
    def mpsfm_notice(self, text: str) -> None:
        self.notices.append(text)

    @hookimpl
    def mpsfm_stage_progress(self, stage: str, done: int, total: int) -> None:
        self.progress.append((stage, done, total))


def test_weights_are_downloaded_once(room: Room, server: Server, configured: Configured) -> None:
    registry, listener = networks(room, server.url), Listener()
    registry.register(listener)
    config = configured(registry)
    (choice,) = [c for c in preview_providers(config, registry).choices if c.block == "depth"]
    assert server.requests == [] and [file.size for file in choice.to_fetch] == [len(CONTENT)]
    first = resolve_providers(config, registry)
    assert names(first) == ["sift", "mutual-nearest", "strong", "strong"]
    assert not any(b.is_unresolved for _, _, b in first.config.provider_configs())
    assert len(server.requests) == 1
    assert listener.progress[-1][0] == "fetch strong.onnx"
    assert listener.notices[0] == f"fetching {server.url}/strong.onnx (0 MB), license MIT"
    assert listener.notices[-2].startswith("depth: strong")
    assert listener.notices[-2].endswith("to expect: published")
    again = resolve_providers(config, registry)
    assert again.config == first.config and len(server.requests) == 1
    assert preview_providers(config, registry).choices[-2].to_fetch == ()


def cut(server: Server) -> None:
    server.cut_after = 0


def wrong(server: Server) -> None:
    server.files["/strong.onnx"] = CONTENT[::-1]


def gone(server: Server) -> None:
    server.files.clear()


@pytest.mark.parametrize(
    ("spoil", "overrides", "why"),
    [
        (cut, (), "cannot be downloaded"),
        (wrong, (), "expected"),
        (gone, (), "404"),
        (None, ("runtime.offline=true",), "downloads are switched off"),
    ],
    ids=["cut connection", "wrong hash", "no such file", "offline"],
)
def test_failed_download_falls_back_to_compact_network(
    room: Room,
    server: Server,
    configured: Configured,
    tmp_path: Path,
    spoil: Callable[[Server], None] | None,
    overrides: tuple[str, ...],
    why: str,
) -> None:
    if spoil is not None:
        spoil(server)
    registry = networks(room, server.url)
    config = configured(registry, *overrides)
    reconstruct(
        room.folder, tmp_path / "out", config, intrinsics=room.intrinsics, registry=registry
    )
    told = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert len(told["images"]["registered"]) == COUNT
    depth, normals = (p for p in told["providers"] if p["block"] in ("depth", "normals"))
    assert depth["name"] == normals["name"] == "compact"
    assert depth["chosen"] == "fallback" and depth["accuracy"] == "measured"
    assert why in depth["passed_over"]["strong"]["detail"]
    assert told["config"]["depth"]["use"] == "compact"


def test_unreachable_server_falls_back(room: Room, configured: Configured) -> None:
    registry = networks(room, "http://127.0.0.1:9")
    assert names(resolve_providers(configured(registry), registry))[2:] == ["compact", "compact"]


def test_named_network_without_weights_is_an_error(
    room: Room, server: Server, configured: Configured
) -> None:
    cut(server)
    registry = networks(room, server.url)
    with pytest.raises(InputError, match=r"strong\.onnx cannot be downloaded"):
        resolve_providers(configured(registry, "depth.use=strong"), registry)


def test_core_without_plugins_reconstructs(room: Room, tmp_path: Path) -> None:
    registry = Registry()
    registry.register(builtin, name="builtin", distribution="mpsfm-core", version="1")
    config = load_config("default", [f"runtime.cache_dir={tmp_path}"], registry)
    result = reconstruct(room.folder, config=config, intrinsics=room.intrinsics, registry=registry)
    assert len(result.summary["images"]["registered"]) == COUNT
    (depth,) = [p for p in result.summary["providers"] if p["block"] == "depth"]
    assert depth["name"] == "flat" and depth["accuracy"].startswith("none")
    assert "pip install 'mpsfm-compact'" in depth["passed_over"]["compact"]["detail"]


@pytest.mark.parametrize(
    ("settings", "expected"),
    [
        (("depth.options.model=FILE",), ["onnx", "from-depth"]),
        (("depth.options.directory=FOLDER",), ["files", "from-depth"]),
        (("depth.use=strong",), ["strong", "strong"]),
        (("depth.use=strong", "normals.use=from-depth"), ["strong", "from-depth"]),
    ],
)
def test_options_alone_select_the_provider_that_has_them(
    room: Room, server: Server, tmp_path: Path, settings: tuple[str, ...], expected: list[str]
) -> None:
    """The default configuration selects the provider by the given options."""
    registry = networks(room, server.url)
    named = weights_from_option("model")
    registry.add(ProviderSpec("depth", "onnx", Network, NamedOptions, weights=named))
    (tmp_path / "net.onnx").touch()
    places = {"FILE": str(tmp_path / "net.onnx"), "FOLDER": str(tmp_path)}
    for name, place in places.items():
        settings = tuple(text.replace(name, place) for text in settings)
    config = load_config("default", [*settings, f"runtime.cache_dir={tmp_path}"], registry)
    assert names(resolve_providers(config, registry))[2:] == expected


@pytest.fixture
def unreadable(tmp_path: Path, room: Room) -> Path:
    """Photos with valid header and without pixel data."""
    folder = tmp_path / "unreadable"
    folder.mkdir()
    for path in room.folder.iterdir():
        (folder / path.name).write_bytes(path.read_bytes()[:200])
    return folder


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["depth.use=compct"], "did you mean 'compact'"),
        (["features.use=superpoint"], "pip install 'mpsfm-lightglue-onnx'"),
        (["depth.use=files", "depth.options.directory=nowhere"], "nowhere does not exist"),
        (["masks=[{use: files, options: {directory: nowhere}}]"], "masks.0.options.directory"),
        (["depth.use=named", "depth.options.model=nowhere.onnx"], "nowhere.onnx does not exist"),
        (["depth.use=strong", "runtime.offline=true"], "mpsfm models fetch http"),
        (["depth.use=torchless"], "needs no_such_package, not installed; pip install it"),
        (["depth.calibration=nowhere.yaml"], "nowhere.yaml' cannot be read"),
        (["pairs.mode=retrieval"], "retrieval: is needed by pairs.mode"),
        (
            ["normals={use: same-network, fallback: []}", "depth.use=flat"],
            "'flat' gives no normals",
        ),
        (["inputs.masks=nowhere"], "masks folder nowhere does not exist"),
    ],
)
def test_missing_requirements_are_reported_before_decoding(
    room: Room, server: Server, unreadable: Path, tmp_path: Path, overrides: list[str], message: str
) -> None:
    registry = networks(room, server.url)
    absent: dict[str, Any] = {"requires": ("no_such_package",), "install_hint": "pip install it"}
    registry.add(
        ProviderSpec("depth", "named", Network, NamedOptions, weights=weights_from_option("model")),
        ProviderSpec("depth", "torchless", Network, **absent),
    )
    settings = [f"runtime.cache_dir={tmp_path}", "depth.use=compact", *overrides]
    with pytest.raises(InputError) as caught:
        reconstruct(unreadable, config="default", overrides=settings, registry=registry)
    assert message in str(caught.value)
    assert not server.requests


def test_wrong_setting_is_reported_before_download(
    room: Room, server: Server, configured: Configured
) -> None:
    registry = networks(room, server.url)
    config = configured(registry, "masks=[{use: files, options: {directory: nowhere}}]")
    with pytest.raises(InputError, match="nowhere does not exist"):
        resolve_providers(config, registry)
    assert not server.requests


def test_config_show_lists_choices_and_hides_expert_settings(tmp_path: Path) -> None:
    settings = ["--set", f"runtime.cache_dir={tmp_path}", "--offline"]
    shown = CliRunner().invoke(build_app(), ["config", "show", "default", *settings]).output
    config, _, comment = shown.partition("# providers on this machine:\n")
    assert "fallback:" in config
    lines = dict(line[2:].split(": ", 1) for line in comment.splitlines())
    fast_pass = {"fast_pass.features", "fast_pass.matcher"}
    assert lines.keys() == fast_pass | {"features", "matcher", "depth", "normals"}
    assert "not moge-2-small" in lines["depth"]
    (tmp_path / "shown.yaml").write_text(shown)
    loaded = load_config(tmp_path / "shown.yaml")
    assert loaded.to_yaml(expert_settings=False) == config.rstrip("\n") + "\n"
    expert = CliRunner().invoke(build_app(), ["config", "show", "default", "--expert", *settings])
    assert "max_pixels:" in expert.output and "max_pixels:" not in config
    assert expert.output.startswith(loaded.to_yaml())
