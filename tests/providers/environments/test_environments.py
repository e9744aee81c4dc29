"""Tests of providers in other Python environments, with crashes, hangs, wrong versions."""

from __future__ import annotations

import pickle
from pathlib import Path

import numpy as np
import pytest

from mpsfm_core.config import load_config
from mpsfm_core.data.errors import InputError, ProviderError, ProviderRunError, WeightsError
from mpsfm_core.data.options import SettingsError
from mpsfm_core.providers.environments import environment as environment_module
from mpsfm_core.providers.environments import remote_provider, worker_process
from mpsfm_core.providers.environments.environment import (
    FOLDER_VARIABLE,
    Environment,
    all_environments,
    create_environment,
    find_environment,
)
from mpsfm_core.providers.environments.worker_process import WorkerLost
from mpsfm_core.providers.kinds.depth import run_depth
from mpsfm_core.providers.provider_config import ProviderConfig
from mpsfm_core.testing.contract import run_checks


def test_providers_are_listed_without_starting_the_environment(registry, monkeypatch):
    monkeypatch.setattr(Environment, "start", lambda self: pytest.fail("started"))
    line = next(line for line in registry.status() if line.name == "far@far")
    assert line.available
    assert (line.distribution, line.version) == ("far-plugin in environment 'far'", "0.3")
    assert line.capabilities == ("joint-normals", "metric")
    assert registry.default_options("depth", "far@far") == {
        "mode": "painted",
        "weights": None,
        "bias": 0.0,
    }
    assert not any(line.name == "sift@far" for line in registry.status())


CHECKS = {"depth-is-z", "depth-joint", "deterministic", "inputs-unchanged", "threads"}


@pytest.mark.parametrize("only", [CHECKS, pytest.param(None, marks=pytest.mark.slow)])
def test_provider_in_environment_passes_the_contract(registry, only):
    results = run_checks(registry, "depth", "far@far", only=only)
    assert not [result for result in results if result.status == "fail"]
    assert {result.id for result in results if result.status == "pass"} >= CHECKS


def test_answers_are_those_of_the_provider(registry, context, named):
    provider = registry.create("depth", "far@far", {"bias": 2.0}, context)
    plain = registry.create("depth", "far@far", None, context)
    view = named("a.png")
    moved, depth = provider.predict(view), plain.predict(view)
    np.testing.assert_allclose(moved.depth[depth.valid], depth.depth[depth.valid] + 2, rtol=1e-6)
    again = plain.predict_joint(view)
    np.testing.assert_array_equal(again[0].depth, depth.depth)
    assert again[1].normals.shape == (*depth.shape, 3)
    matches = registry.create("matcher", "far-matcher@far", None, context).match(view, view)
    assert len(matches.dense) == 1


def test_configuration_selects_provider_in_environment(registry):
    config = load_config("fast-cpu", ["depth.use=far", "depth.environment=far"], registry=registry)
    assert config.depth.use == "far@far"
    assert config.depth.options["mode"] == "painted"
    with pytest.raises(InputError, match=r"depth\.options\.modus: unknown key.*'mode'"):
        load_config(
            "fast-cpu",
            ["depth.use=far", "depth.environment=far", "depth.options.modus=x"],
            registry=registry,
        )
    with pytest.raises(InputError, match="in an environment 'near': 'mpsfm env list' shows"):
        load_config("fast-cpu", ["depth.use=far", "depth.environment=near"], registry=registry)


def test_environment_given_twice_raises():
    assert ProviderConfig.model_validate({"use": "a", "environment": "b"}).use == "a@b"
    with pytest.raises(ValueError, match="already selects an environment"):
        ProviderConfig.model_validate({"use": "a@c", "environment": "b"})


def test_options_are_checked_there_and_survive_pickling(registry):
    options = registry.validate_options("depth", "far@far", {"bias": "1.5"})
    assert options.model_dump()["bias"] == 1.5
    again = pickle.loads(pickle.dumps(options))
    assert again.model_dump() == options.model_dump()
    with pytest.raises(SettingsError, match=r"^here\.bias: "):
        registry.validate_options("depth", "far@far", {"bias": "much"}, ("here",))


def test_weights_are_found_by_this_process(registry, tmp_path):
    from mpsfm_core import ProviderContext

    asked = []

    def resolve(uri, sha256):
        asked.append(uri)
        if uri == "absent.pt":
            raise WeightsError("absent.pt is not on this machine")
        return tmp_path / uri

    context = ProviderContext(resolve_weights=resolve)
    registry.create("depth", "far@far", {"weights": "net.pt"}, context)
    assert asked == ["net.pt"]
    with pytest.raises(WeightsError, match="not on this machine"):
        registry.create("depth", "far@far", {"weights": "absent.pt"}, context)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("crash", "crashed \\(SIGSEGV\\)"),
        ("memory", "was killed from outside, most likely because memory ran out"),
        ("exit", "ended by itself \\(exit code 3\\); its last line: goodbye"),
        ("error", "IndexError: tensor of 3 dimensions"),
        ("ours", "far.pt is damaged"),
    ],
)
def test_failure_of_provider_ends_one_call(registry, context, named, name, message):
    provider = registry.create("depth", "far@far", None, context)
    spec = registry.spec("depth", "far@far")
    with pytest.raises((ProviderRunError, WeightsError), match=message):
        run_depth(spec, provider, named(name))
    assert run_depth(spec, provider, named("next.png")).valid.any()


def test_a_worker_that_hangs(registry, context, named, monkeypatch):
    provider = registry.create("depth", "far@far", None, context)
    provider.predict(named("first.png"))
    with monkeypatch.context() as hurry:
        hurry.setattr(remote_provider, "_CALL_TIMEOUT_S", 1.0)
        with pytest.raises(WorkerLost, match="did not answer within 1 s"):
            provider.predict(named("hang"))
    assert provider.predict(named("next.png")).valid.any()


def test_construction_failure_in_environment_raises(registry, context):
    with pytest.raises(ProviderError, match="ImportError: libcudart"):
        registry.create("depth", "far@far", {"mode": "unbuildable"}, context)


def test_another_version_of_the_protocols(far, monkeypatch):
    monkeypatch.setattr(worker_process, "PROTOCOL", 99)
    with pytest.raises(ProviderError, match="whose protocol version"):
        far.start()


def test_environment_that_does_not_start_raises(tmp_path):
    broken = Environment(tmp_path / "broken")
    broken.python.parent.mkdir(parents=True)
    broken.python.write_text("#!/bin/sh\necho 'no numpy here' >&2\nexit 1\n")
    broken.python.chmod(0o755)
    with pytest.raises(ProviderError, match=r"environment 'broken' ended .*no numpy here"):
        broken.start()


def test_invalid_or_missing_environment_names_raise(monkeypatch, tmp_path):
    monkeypatch.setenv(FOLDER_VARIABLE, str(tmp_path))
    with pytest.raises(InputError, match="lower-case"):
        create_environment("Not a name", ["x"])
    with pytest.raises(InputError, match="no provider environment 'x'"):
        find_environment("x")
    (tmp_path / "there").mkdir()
    with pytest.raises(InputError, match="mpsfm env remove there"):
        create_environment("there", ["x"])


def test_environment_is_created_completely_or_not_at_all(monkeypatch, tmp_path):
    """Check that an environment is created next to its final folder, invisible to other
    processes."""
    monkeypatch.setenv(FOLDER_VARIABLE, str(tmp_path))
    seen = []

    def made(command, label):
        python = Path(command[0])
        python.parent.mkdir(parents=True, exist_ok=True)
        python.touch()
        python.with_name("pip").write_text(f"#!{python}\nimport pip\n")
        seen.append([environment.name for environment in all_environments()])

    monkeypatch.setattr(
        environment_module, "_commands", lambda e, packages, python: [[str(e.python)]]
    )
    monkeypatch.setattr(environment_module, "_run", made)
    monkeypatch.setattr(Environment, "ask", lambda self, **request: [])
    environment, found = create_environment("new", ["x"])
    assert (seen, found) == ([[]], [])
    assert [e.name for e in all_environments()] == ["new"] and environment.python.exists()
    assert [path.name for path in tmp_path.iterdir()] == ["new"]
    script = environment.python.with_name("pip").read_text()
    assert script.splitlines()[0] == f"#!{environment.python}"


@pytest.mark.slow
def test_failed_installation_leaves_no_environment(monkeypatch, tmp_path):
    monkeypatch.setenv(FOLDER_VARIABLE, str(tmp_path))
    with pytest.raises(ProviderError, match="cannot be created"):
        create_environment("new", [str(tmp_path / "nowhere")])
    assert not list(tmp_path.iterdir())
