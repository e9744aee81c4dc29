"""Tests of the contract under pytest: by option, in a plugin's test file, and on the command
line."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from typer.testing import CliRunner

from mpsfm_core.cli import build_app

ROOT = Path(__file__).resolve().parents[2]

SOURCE = """
    from mpsfm_core import Options, ProviderSpec, hookimpl
    from tests.support.reference_providers import PaintedDepth

    class HereOptions(Options):
        factor: float = 1.0

    class Here(PaintedDepth):
        def predict(self, view):
            prior = super().predict(view)
            scaled = prior.depth * self.options.factor
            return type(prior)(scaled.astype("float32"), prior.variance, prior.valid)

    def contract(folder):
        from mpsfm_core.testing import ContractSetup
        failures = {"flat": "is too honest to pass"}
        return ContractSetup(truth_source="painted", expected_failures=failures)

    @hookimpl
    def mpsfm_providers():
        return [ProviderSpec("depth", "here", __name__ + ":Here", HereOptions,
                             contract=__name__ + ":contract")]
"""


@pytest.fixture
def site(install_plugin: Callable[..., str], monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a folder with the installed plugin ``mpsfm-here``, which child processes find too."""
    install_plugin("mpsfm-here", SOURCE)
    folder = Path(sys.path[0])
    paths = (str(folder), str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")]))
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(paths))
    return folder


def run_pytest(folder: Path, *arguments: str) -> tuple[int, str]:
    command = [sys.executable, "-m", "pytest", "-p", "mpsfm_pytest", "-p", "no:cacheprovider"]
    ended = subprocess.run(
        [*command, *arguments], cwd=folder, capture_output=True, text=True, timeout=120
    )
    return ended.returncode, ended.stdout + ended.stderr


def test_by_option(site: Path, tmp_path: Path) -> None:
    (tmp_path / "test_other.py").write_text("def test_other(): assert False")
    code, output = run_pytest(tmp_path, "--mpsfm-plugin", "mpsfm-here", "-v", "-k", "flat or flip")
    assert code == 1
    assert "depth/here::depth-flip PASSED" in output
    assert "depth/here::flat FAILED" in output
    assert "passes, and was expected to fail: is too honest to pass" in output
    assert "test_other" not in output  # No path was given on the command line.
    named = ("--mpsfm-plugin", "here", "--collect-only", "-q", "test_other.py")
    code, output = run_pytest(tmp_path, *named)
    assert "test_other.py::test_other" in output and "depth/here::depth-is-z" in output


def test_by_option_with_options(site: Path, tmp_path: Path) -> None:
    arguments = ("--mpsfm-plugin=here", "--mpsfm-options=factor=2", "-rs", "-k", "is-z or pickles")
    code, output = run_pytest(tmp_path, *arguments)
    assert code == 0
    assert "1 passed, 1 skipped" in output
    assert "ground truth is unknown" in output


def test_by_option_without_such_a_plugin(site: Path, tmp_path: Path) -> None:
    code, output = run_pytest(tmp_path, "--mpsfm-plugin", "hear")
    assert code == pytest.ExitCode.USAGE_ERROR
    assert "did you mean 'here'" in output


def test_in_a_file_of_ones_own(site: Path, tmp_path: Path) -> None:
    (tmp_path / "test_mine.py").write_text(
        "from mpsfm_core.testing import ContractSetup, contract_tests\n"
        "test_mine = contract_tests('depth', 'here', ContractSetup({'factor': 3}, 'painted'))\n"
    )
    code, output = run_pytest(tmp_path, "-q", "-k", "is-z or depth-scale")
    assert code == 1
    assert "1 failed, 1 passed" in output
    assert "is declared metric and is 3 times the true depth" in output


def test_pytest_without_option_imports_no_core(tmp_path: Path) -> None:
    """Check that pytest without the option imports only the module mpsfm_pytest."""
    (tmp_path / "test_other.py").write_text(
        "import sys\n"
        "def test_other():\n"
        "    assert not [m for m in sys.modules if m.startswith(('mpsfm_core', 'numpy'))]\n"
        "    assert 'mpsfm_pytest' in sys.modules\n"
    )
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1"}
    command = [sys.executable, "-m", "pytest", "-p", "mpsfm_pytest", "-q"]
    ended = subprocess.run(
        command, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=120
    )
    assert ended.returncode == 0, ended.stdout


def test_collecting_imports_nothing_heavy(site: Path, tmp_path: Path) -> None:
    (tmp_path / "conftest.py").write_text(
        "import sys\n"
        "def pytest_collection_finish(session):\n"
        "    heavy = {'torch', 'onnxruntime', 'kornia', 'cv2', 'scipy', 'pycolmap', 'numba'}\n"
        "    print('heavy:', sorted(heavy & set(sys.modules)))\n"
    )
    code, output = run_pytest(
        tmp_path, "--mpsfm-plugin", "here", "--mpsfm-plugin", "sift", "--collect-only", "-q", "."
    )
    assert code == 0
    assert "depth/here::depth-is-z" in output
    assert "heavy: []" in output


def test_the_command_line(site: Path) -> None:
    def check(*arguments: str) -> tuple[int, str]:
        result = CliRunner().invoke(build_app(), ["plugins", "check", *arguments])
        return result.exit_code, result.output

    code, output = check("depth/here", "--only", "depth-is-z", "--only", "light-import")
    assert code == 0
    assert "pass  depth/here: depth-is-z" in output
    assert output.splitlines()[-1] == "2 pass"

    code, output = check("mpsfm-here", "--only", "flat", "--json")
    assert code == 1
    (result,) = json.loads(output)
    assert result["provider"] == "depth/here" and result["around"] == ""
    assert (result["id"], result["status"]) == ("flat", "fail")

    code, output = check("here", "--set", "factor=2", "--only", "depth-scale", "--json")
    assert (code, json.loads(output)[0]["status"]) == (0, "unmeasured")

    for wrong, message in (
        (("hear",), "did you mean 'here'"),
        (("here", "--only", "depth-z"), "no check 'depth-z'; did you mean 'depth-is-z'"),
        (("here", "--set", "factor"), "must look like key=value"),
    ):
        code, output = check(*wrong)
        assert code == 2
        assert message in output
