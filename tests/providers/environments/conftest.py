"""Fixtures with another Python environment whose plugin is not installed in this one."""

from __future__ import annotations

import shutil
import sysconfig
import venv
from pathlib import Path

import pytest

import mpsfm_core
from mpsfm_core import PinholeCamera, ProviderContext, View
from mpsfm_core.providers.environments.environment import FOLDER_VARIABLE, Environment
from mpsfm_core.providers.registry import Registry
from mpsfm_core.testing.examples import outdoor_example


@pytest.fixture(scope="session")
def far(tmp_path_factory: pytest.TempPathFactory) -> Environment:
    """The environment ``far``. The environment links to the packages of the test environment, so
    nothing is downloaded."""
    root = tmp_path_factory.mktemp("environments")
    environment = Environment(root / "far")
    venv.create(environment.folder / "venv", with_pip=False, symlinks=True)
    (site,) = (environment.folder / "venv").glob("**/site-packages")
    here = sysconfig.get_paths()["purelib"]
    core = Path(mpsfm_core.__file__).parents[1]
    (site / "lent.pth").write_text(f"{core}\nimport site; site.addsitedir({here!r})\n")
    shutil.copy(Path(__file__).with_name("far_plugin.py"), site)
    metadata = site / "far_plugin-0.3.dist-info"
    metadata.mkdir()
    (metadata / "METADATA").write_text("Metadata-Version: 2.1\nName: far-plugin\nVersion: 0.3\n")
    (metadata / "entry_points.txt").write_text("[mpsfm.plugins]\nfar = far_plugin\n")
    environment.refresh()
    return environment


@pytest.fixture
def registry(far: Environment, monkeypatch: pytest.MonkeyPatch) -> Registry:
    monkeypatch.setenv(FOLDER_VARIABLE, str(far.folder.parent))
    return Registry.discover()


@pytest.fixture
def context(tmp_path: Path) -> ProviderContext:
    return ProviderContext(resolve_weights=lambda uri, sha256: tmp_path / uri)


@pytest.fixture(scope="session")
def painted() -> View:
    return outdoor_example("painted").view


@pytest.fixture
def named(painted: View):
    """Return the painted view with a name at which the remote test plugin fails."""

    def named(name: str) -> View:
        camera: PinholeCamera = painted.camera
        return View(name, painted.image, camera)

    return named
