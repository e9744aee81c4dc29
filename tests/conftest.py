"""Fixtures shared by all tests."""

from __future__ import annotations

import sys
import textwrap
from collections.abc import Callable, Iterator

import hypothesis
import pycolmap
import pytest

hypothesis.settings.register_profile("repeatable", derandomize=True, deadline=None)
hypothesis.settings.load_profile("repeatable")


@pytest.fixture
def model() -> pycolmap.Reconstruction:
    """A COLMAP model of five views and twenty points."""
    pycolmap.set_random_seed(0)
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig = 1, 1
    options.num_frames_per_rig = 5
    options.num_points3D = 20
    return pycolmap.synthesize_dataset(options)


InstallPlugin = Callable[..., str]


@pytest.fixture
def install_plugin(
    tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch
) -> Iterator[InstallPlugin]:
    """Installs a plugin distribution for the test: ``install_plugin("mpsfm-tiny", source)``.

    Writes a module with ``source`` and a real dist-info folder with its entry point to a folder on
    ``sys.path``, and returns the module's name. ``entry_points`` replaces the text of
    entry_points.txt.
    """
    site = tmp_path_factory.mktemp("site")
    monkeypatch.syspath_prepend(str(site))
    installed: list[str] = []

    def install(
        distribution: str,
        source: str,
        *,
        version: str = "1.0",
        entry_points: str | None = None,
    ) -> str:
        module = distribution.replace("-", "_") + "_plugin"
        (site / f"{module}.py").write_text(textwrap.dedent(source))
        info = site / f"{distribution.replace('-', '_')}-{version}.dist-info"
        info.mkdir()
        metadata = f"Metadata-Version: 2.1\nName: {distribution}\nVersion: {version}\n"
        (info / "METADATA").write_text(metadata)
        default = f"[mpsfm.plugins]\n{distribution} = {module}\n"
        (info / "entry_points.txt").write_text(entry_points or default)
        installed.append(module)
        return module

    yield install
    for module in installed:
        sys.modules.pop(module, None)
