"""Tests that each shipped configuration loads, fits the plugins and is documented."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import yaml

from mpsfm_core.config import Config, describe_shipped, load_config, shipped_configs
from mpsfm_core.data.errors import ConfigError
from mpsfm_core.data.options import SettingsError, dotted
from mpsfm_core.pipeline.provider_resolution import preview_providers, resolve_providers
from mpsfm_core.providers.first_party import PLUGIN_PROVIDERS, requirement_for
from mpsfm_core.providers.provider_config import SAME_NETWORK
from mpsfm_core.providers.registry import CORE, Registry
from mpsfm_core.providers.uncertainty.calibration import DepthCalibration, NormalCalibration
from mpsfm_core.providers.weights import is_remote

NAMES = sorted(shipped_configs())
ROOT = Path(__file__).parents[2]
GUIDE = ROOT / "docs" / "backends.md"


@pytest.fixture(scope="module")
def registry() -> Registry:
    """Registry of all plugins; tests are skipped if a plugin is not installed."""
    registry = Registry.discover()
    here = {line.distribution for line in registry.status()}
    missing = {home.partition("[")[0] for home in PLUGIN_PROVIDERS} - here
    if missing:
        pytest.skip(f"needs {', '.join(sorted(missing))}")
    return registry


def closed(config: Config, registry: Registry) -> Config:
    """Return the configuration with the first choice of each provider block."""
    joint = "joint-normals" in registry.spec("depth", config.depth.use).capabilities
    for path, _, backend in list(config.provider_configs()):
        chosen = {"use": backend.use, "fallback": ()}
        if backend.use == SAME_NETWORK and joint:
            chosen |= {"use": config.depth.use, "options": config.depth.options}
        elif backend.use == SAME_NETWORK:
            chosen["use"] = backend.fallback[0]
        config = config.replaced(path, backend.model_copy(update=chosen))
    return config


def required(config: Config, registry: Registry) -> list[str]:
    """Return the required options without default, as ``--set`` keys."""
    found = []
    for path, kind, backend in closed(config, registry).provider_configs():
        given = {key: value for key, value in backend.options.items() if value is not None}
        try:
            registry.validate_options(kind, backend.use, given)
        except SettingsError as error:
            found += [dotted((*path, "options", *problem.path[-1:])) for problem in error.problems]
    return found


@pytest.mark.parametrize("name", NAMES)
def test_shipped_configuration_loads_and_resolves(name: str, registry: Registry) -> None:
    config = load_config(name, (), registry, complete=False)
    assert describe_shipped()[name]
    complete = load_config(name, [f"{o}=FILE" for o in required(config, registry)], registry)
    complete = closed(complete, registry)
    for path, kind, backend in complete.provider_configs():
        chosen = [(kind, backend.use), *(("wrapper", w.use) for w in backend.wrap)]
        for each in chosen:
            spec = registry.spec(*each)
            home = registry.version(*each).split()[0]
            assert home == CORE or requirement_for(*each).partition("[")[0] == home
            assert spec.code_license != "unknown" and spec.summary, path
    assert isinstance(registry.calibration("depth", complete.depth), DepthCalibration)
    assert isinstance(registry.calibration("normals", complete.normals), NormalCalibration)


@pytest.mark.parametrize("name", NAMES)
def test_shipped_configuration_documents_required_options(name: str, registry: Registry) -> None:
    """A comment of the configuration file or of its parents shows the ``--set`` option."""
    texts = {path.stem: path.read_text(encoding="utf-8") for path in shipped_configs().values()}
    text, parent = "", name
    while parent:
        text += texts[parent]
        parent = yaml.safe_load(texts[parent]).get("extends")
    for option in required(load_config(name, (), registry, complete=False), registry):
        assert f"--set {option}=" in text


@pytest.mark.parametrize("name", NAMES)
def test_shipped_configuration_needs_only_available_weights(
    name: str, registry: Registry, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Only sensor depth, MASt3R and RoMa need file names, because their files are not published."""
    monkeypatch.setenv("MPSFM_EXPORTS", str(tmp_path))
    file = tmp_path / "dsine.onnx"
    file.touch()
    (tmp_path / "dsine.json").write_text(json.dumps({"file": str(file)}))
    named = {
        "sensor-depth": [f"depth.options.directory={tmp_path}"],
        "paper-mast3r": [f"matcher.options.model={file}"],
        "paper-dense": [f"{m}.options.model={file}" for m in ("matcher", "dense_matcher")],
    }.get(name, [])
    config = load_config(name, [*named, f"runtime.cache_dir={tmp_path}"], registry)
    files = [f for choice in preview_providers(config, registry).choices for f in choice.to_fetch]
    assert all(is_remote(file.uri) and file.license != "unknown" for file in files)


@pytest.mark.parametrize("name", NAMES)
def test_shipped_configuration_without_plugins_names_package(name: str, registry: Registry) -> None:
    """Without plugins, the error names the packages of the missing providers."""
    config = load_config(name, (), registry, complete=False)
    wanted = [
        (kind, name)
        for _, kind, backend in config.provider_configs()
        for name in (backend.use, *backend.fallback)
        if SAME_NETWORK not in (backend.use, *backend.fallback)
    ]
    hints = [f"pip install '{home}'" for choice in wanted if (home := requirement_for(*choice))]
    with pytest.raises(ConfigError) as caught:
        load_config(name, (), Registry(), complete=False)
    assert all(hint in str(caught.value) for hint in hints)


def test_depth_and_normals_of_one_network_have_same_options(registry: Registry) -> None:
    for name in NAMES:
        config = closed(load_config(name, (), registry, complete=False), registry)
        joint = "joint-normals" in registry.spec("depth", config.depth.use).capabilities
        if joint and config.depth.use == config.normals.use and not config.normals.wrap:
            assert config.depth.options == config.normals.options


@pytest.mark.parametrize("name", NAMES)
def test_shipped_configuration_is_in_guide_and_readme(name: str) -> None:
    assert f"| `{name}` |" in GUIDE.read_text(encoding="utf-8")
    assert f"`{name}`" in (ROOT / "README.md").read_text(encoding="utf-8")


def test_every_first_party_provider_is_documented(registry: Registry) -> None:
    """The core knows which package provides each first-party provider."""
    text = GUIDE.read_text(encoding="utf-8")
    homes = {home.partition("[")[0] for home in PLUGIN_PROVIDERS}
    found = set()
    for line in registry.status():
        if line.distribution in homes and line.kind != "plugin":
            found.add(f"{line.kind}/{line.name}")
            short = line.name.removeprefix("metric3d-v2")
            assert f"`{line.name}`" in text or f"`{short}`" in text, f"{line.kind} {line.name}"
    assert found == {provider for brought in PLUGIN_PROVIDERS.values() for provider in brought}


@pytest.mark.parametrize("name", ["default", "fast-cpu", "demo"])
def test_shipped_configuration_resolves_offline(
    name: str, registry: Registry, tmp_path: Path
) -> None:
    offline = ("runtime.offline=true", f"runtime.cache_dir={tmp_path}")
    provision = resolve_providers(load_config(name, offline, registry), registry)
    assert provision.config.depth.use == provision.config.normals.use == "compact"
