"""Tests of merging, overrides and error messages of configurations."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import pytest
from pydantic import Field

from mpsfm_core import Options, ProviderSpec
from mpsfm_core.config import Config, load_config, shipped_configs
from mpsfm_core.data.errors import ConfigError
from mpsfm_core.providers.registry import Registry
from mpsfm_core.support.yaml_text import parse_yaml, write_yaml

Load = Callable[..., Config]


class FileOptions(Options):
    directory: Path
    scale: float = Field(1.0, gt=0)
    weights: dict[str, float] = Field(default_factory=dict)


class NetworkOptions(Options):
    model: str | None = None
    mean: tuple[float, ...] = (0.0, 0.0, 0.0)


class KeypointOptions(Options):
    max_keypoints: int = 2048


def factory(*_: object) -> None:
    """Provider factory that no test of this module calls."""


def make_registry() -> Registry:
    """Registry with fake providers for all names in the shipped configurations."""
    sparse, dense = frozenset({"sparse"}), frozenset({"dense"})
    registry = Registry()
    registry.add(
        ProviderSpec("features", "xfeat", factory, KeypointOptions, tags=("xfeat",)),
        ProviderSpec("features", "sift", factory, KeypointOptions, tags=("sift",)),
        ProviderSpec("matcher", "lighterglue", factory, capabilities=sparse, tags=("xfeat",)),
        ProviderSpec("matcher", "mutual-nearest", factory, capabilities=sparse),
        ProviderSpec("matcher", "loftr", factory, capabilities=dense),
        ProviderSpec("depth", "onnx", factory, NetworkOptions),
        ProviderSpec("depth", "files", factory, FileOptions),
        ProviderSpec("depth", "matcher", factory),
        ProviderSpec("normals", "from-depth", factory),
        ProviderSpec("mask", "files", factory, FileOptions),
        ProviderSpec("wrapper", "flip", factory, capabilities=frozenset({"wraps-depth"})),
        ProviderSpec("wrapper", "tilt", factory, capabilities=frozenset({"wraps-normals"})),
    )
    return registry


@pytest.fixture
def load(tmp_path: Path) -> Load:
    """``load(text, *overrides)`` loads a configuration written to ``run.yaml``."""

    def load(text: str, *overrides: str, complete: bool = True) -> Config:
        path = tmp_path / "run.yaml"
        path.write_text(text)
        return load_config(path, overrides, make_registry(), complete=complete)

    return load


def error_of(load: Load, text: str, *overrides: str) -> str:
    with pytest.raises(ConfigError) as caught:
        load(text, *overrides)
    return str(caught.value)


QUICK = "{features: {use: sift}, matcher: {use: mutual-nearest}}"


class TestMerging:
    def test_child_file_replaces_named_settings(self, load: Load) -> None:
        config = load(
            "extends: fast-cpu\nfeatures:\n  options:\n    max_keypoints: 7\nruntime: {seed: 3}\n"
        )
        assert config.features is not None and config.matcher is not None
        assert config.features.use == "xfeat"
        assert config.features.options == {"max_keypoints": 7}
        assert config.matcher.use == "lighterglue"
        assert config.runtime.seed == 3
        assert config.description == ""

    def test_other_provider_drops_options_of_parent(self, load: Load, tmp_path: Path) -> None:
        (tmp_path / "parent.yaml").write_text(
            "extends: fast-cpu\n"
            "depth:\n  use: onnx\n  options: {model: a.onnx}\n  wrap: [{use: flip}]\n"
        )
        kept = load("extends: parent.yaml\ndepth: {use: onnx}\n")
        assert kept.depth.options["model"] == "a.onnx"
        assert [wrapper.use for wrapper in kept.depth.wrap] == ["flip"]
        changed = load("extends: parent.yaml\ndepth:\n  use: files\n  options: {directory: d}\n")
        assert changed.depth.options == {"directory": "d", "scale": 1.0, "weights": {}}
        assert changed.depth.wrap == ()

    def test_extends_path_is_relative_to_its_file(self, tmp_path: Path) -> None:
        (tmp_path / "sub").mkdir()
        (tmp_path / "base.yaml").write_text("extends: fast-cpu\nruntime: {threads: 5}\n")
        (tmp_path / "sub" / "run.yaml").write_text("extends: ../base.yaml\n")
        config = load_config(tmp_path / "sub" / "run.yaml", (), make_registry())
        assert config.runtime.threads == 5

    def test_null_removes_block(self, load: Load) -> None:
        config = load("extends: fast-cpu\nmatcher: null\ndense_matcher: {use: loftr}\n")
        assert config.matcher is None
        assert config.dense_matcher is not None

    @pytest.mark.parametrize(
        ("text", "overrides", "kept"),
        [
            ("features: {options: {max_keypoints: 7}}", (), True),
            ("depth: {use: files, options: {directory: maps}}", (), True),
            ("fast_pass: null", (), False),
            ("features: {use: xfeat}", (), False),
            ("dense_matcher: {use: loftr}", (), False),
            ("", ("matcher.use=lighterglue",), False),
            (f"features: {{use: xfeat}}\nfast_pass: {QUICK}", (), True),
            ("", (f"fast_pass={QUICK}", "matcher.use=lighterglue"), True),
        ],
    )
    def test_naming_a_matcher_drops_the_fast_pass(
        self, load: Load, text: str, overrides: Sequence[str], kept: bool
    ) -> None:
        fast_pass = load(f"extends: fast-cpu\n{text}", *overrides).fast_pass
        assert (fast_pass is not None) == kept
        if fast_pass is not None:
            assert (fast_pass.features.use, fast_pass.matcher.use) == ("sift", "mutual-nearest")

    @pytest.mark.parametrize(
        ("text", "overrides", "named"),
        [
            ("matcher: {use: lighterglue}", (), "run.yaml:2: naming matcher disables the fast"),
            ("", ("features.use=xfeat",), "--set features.use=xfeat: naming features disables"),
            ("depth: {use: files, options: {directory: maps}}", (), None),
            ("fast_pass: null\nmatcher: {use: lighterglue}", (), None),
            ("matcher: {use: lighterglue}", (f"fast_pass={QUICK}",), None),
        ],
    )
    def test_dropping_the_fast_pass_implicitly_warns(
        self, load: Load, text: str, overrides: Sequence[str], named: str | None
    ) -> None:
        warnings = load(f"extends: fast-cpu\n{text}", *overrides).warnings
        assert len(warnings) == (named is not None)
        if named is not None:
            assert named in warnings[0]

    def test_shipped_configurations_have_no_warnings(self) -> None:
        for name in ("sift", "fast-cpu"):
            assert load_config(name, (), make_registry()).warnings == ()

    def test_extends_in_a_circle_is_an_error(self, tmp_path: Path) -> None:
        (tmp_path / "a.yaml").write_text("extends: b.yaml\n")
        (tmp_path / "b.yaml").write_text("extends: a.yaml\n")
        with pytest.raises(ConfigError, match=r"circle: .*a\.yaml -> .*b\.yaml -> .*a\.yaml"):
            load_config(tmp_path / "a.yaml", (), make_registry())


class TestOverrides:
    def test_override_values_are_yaml(self, load: Load) -> None:
        config = load(
            "extends: fast-cpu\n",
            "depth.options.model=runs/2024-01-01",
            "depth.options.mean=[1, 2e-3, .5]",
            "runtime.offline=true",
            "runtime.device=cpu",
        )
        assert config.depth.options == {"model": "runs/2024-01-01", "mean": [1, 0.002, 0.5]}
        assert config.runtime.offline and config.runtime.device == "cpu"

    @pytest.mark.parametrize(
        "overrides",
        [
            ("depth.use=files", "depth.options.directory=d"),
            ("depth.options.directory=d", "depth.use=files"),
            ("depth={use: files, options: {directory: d}}",),
        ],
    )
    def test_order_of_overrides_does_not_matter(self, load: Load, overrides: Sequence[str]) -> None:
        config = load("extends: fast-cpu\ndepth: {options: {model: a}}\n", *overrides)
        assert config.depth.options["directory"] == "d"

    def test_override_of_list_entry_by_index(self, load: Load) -> None:
        text = "extends: fast-cpu\n"
        masks = ("masks.0.use=files", "masks.0.options.directory=m")
        assert load(text, *masks).masks[0].options["directory"] == "m"
        text += "masks: [{use: files, options: {directory: a, scale: 2}}]\n"
        config = load(text, "masks.1={use: files, options: {directory: c}}", *masks)
        assert [mask.options["directory"] for mask in config.masks] == ["m", "c"]
        assert [mask.options["scale"] for mask in config.masks] == [2.0, 1.0]

    @pytest.mark.parametrize("text", ["runtime.seed", "=3", "runtime..seed=3"])
    def test_override_without_assignment_is_an_error(self, load: Load, text: str) -> None:
        assert f"--set {text}: a setting must look like a.b=value" in error_of(
            load, "extends: fast-cpu\n", text
        )

    def test_override_beyond_end_of_list_is_an_error(self, load: Load) -> None:
        message = error_of(load, "extends: fast-cpu\n", "masks.2.use=files")
        assert message == "--set masks.2.use=files: no list entry 2, because the list has 0 entries"


class TestErrors:
    @pytest.mark.parametrize(
        ("text", "message"),
        [
            ("mapping:\n  seed: 1\n", ":3: mapping.seed: unknown key"),
            ("runtime:\n  sed: 1\n", ":3: runtime.sed: unknown key; did you mean 'seed'?"),
            ("runtme: {}\n", ":2: runtme: unknown key; did you mean 'runtime'?"),
            ("runtime:\n  device: gpu\n", ":3: runtime.device: Input should be 'auto'"),
            ("depth:\n  use: onxn\n", ":3: depth.use: no depth provider 'onxn'; did you mean"),
            ("depth:\n  options:\n    modle: x\n", ":4: depth.options.modle: unknown key; did"),
            ("depth: {use: files}\n", ":2: depth.options.directory: is required"),
            ("masks:\n- use: files\n- ues: 1\n", ":4: masks.1.use: is required"),
            ("masks: {use: files}\n", ":2: masks: "),
            ("depth: onnx\n", ":2: depth: "),
            ("depth:\n  wrap:\n  - use: flap\n", ":4: depth.wrap.0.use: no wrapper provider"),
            ("depth:\n  wrap:\n  - use: tilt\n", ":4: depth.wrap.0.use: 'tilt' does not wrap"),
            (
                "runtime: {seed: 1}\nruntime: {seed: 2}\n",
                ":3: the text is not valid YAML: key 'runtime' rep",
            ),
            ("runtime: [\n", "not valid YAML"),
            ("depth:\n  calibration: {relative: 1}\n", ":3: depth.calibration.relative: unknown"),
            ("depth:\n  calibration: nowhere.yaml\n", ":3: depth.calibration: calibration file"),
            ("features:\n  calibration: {a: 1}\n", ":3: features.calibration: a features provid"),
            ("matcher: {use: loftr}\n", ":2: matcher.use: 'loftr' is not a sparse matcher"),
            ("dense_matcher: {use: lighterglue}\n", ":2: dense_matcher.use: 'lighterglue' is not"),
            ("matcher: null\n", ":2: matcher: a matcher or a dense_matcher is needed"),
            ("features: null\n", ":2: features: is needed by the sparse matcher 'lighterglue'"),
            (
                "fast_pass: {matcher: {use: loftr}}\n",
                ":2: fast_pass.matcher.use: 'loftr' is not a sparse",
            ),
            (
                "fast_pass: {features: {use: sfit}}\n",
                ":2: fast_pass.features.use: no features provider",
            ),
            (
                "fast_pass: {}\ndepth: {use: matcher}\n",
                ": fast_pass: predicts no depth, which depth.use: mat",
            ),
            (
                "features: {use: sift}\nmatcher: {use: lighterglue}\n",
                ":3: matcher.use: 'lighterglue' matches xfeat features, not 'sift'",
            ),
        ],
    )
    def test_error_names_file_line_path_and_nearest_key(
        self, load: Load, tmp_path: Path, text: str, message: str
    ) -> None:
        told = error_of(load, f"extends: fast-cpu\n{text}")
        assert message in told
        assert str(tmp_path) in told

    def test_error_in_override_quotes_the_override(self, load: Load) -> None:
        message = error_of(load, "extends: fast-cpu\n", "runtime.seed=-1", "depth.ues=onnx")
        assert "--set runtime.seed=-1: runtime.seed: " in message
        assert "--set depth.ues=onnx: depth.ues: unknown key; did you mean 'use'?" in message

    def test_errors_of_all_providers_are_reported_together(self, load: Load) -> None:
        message = error_of(load, "extends: fast-cpu\n", "depth.use=a", "normals.use=b")
        assert "no depth provider 'a'" in message and "no normals provider 'b'" in message

    def test_missing_configuration_is_an_error(self, load: Load, tmp_path: Path) -> None:
        with pytest.raises(ConfigError, match="no configuration 'fast-cup'; did you mean 'fast-c"):
            load_config("fast-cup", (), make_registry())
        with pytest.raises(ConfigError, match=r"gone\.yaml: no such configuration file"):
            load_config(tmp_path / "gone.yaml", (), make_registry())
        message = error_of(load, "runtime: {}\nextends: gone.yaml\n")
        assert ":2: extends: " in message and "no such configuration file" in message

    @pytest.mark.parametrize(
        ("content", "message"),
        [(b"- a\n", "must be a mapping, is a list"), (b"\xff\xfe\x00", "cannot be read")],
    )
    def test_file_without_mapping_is_an_error(
        self, tmp_path: Path, content: bytes, message: str
    ) -> None:
        (tmp_path / "run.yaml").write_bytes(content)
        with pytest.raises(ConfigError, match=message):
            load_config(tmp_path / "run.yaml", (), make_registry())


class TestResult:
    def test_effective_configuration_reloads_unchanged(self, load: Load, tmp_path: Path) -> None:
        config = load(
            "extends: fast-cpu\n",
            "depth.options.model='1e-3'",
            "depth.wrap.0.use=flip",
            "depth.calibration={relative_std: 1e-9}",
            "masks.0={use: files, options: {directory: 'no', weights: {a: .inf}}}",
        )
        (tmp_path / "effective.yaml").write_text(config.to_yaml())
        again = load_config(tmp_path / "effective.yaml", (), make_registry())
        assert again == config
        assert again.depth.options["model"] == "1e-3"

    def test_calibration_path_is_relative_to_its_configuration(
        self, load: Load, tmp_path: Path
    ) -> None:
        (tmp_path / "kitchen.json").write_text('{"relative_std": 0.07}')
        config = load("extends: fast-cpu\ndepth: {calibration: kitchen.json}\n")
        assert isinstance(config.depth.calibration, dict)
        assert config.depth.calibration["relative_std"] == 0.07
        assert config.depth.calibration["std_floor"] == 0.02

    def test_incomplete_configuration_loads_if_allowed(self, load: Load) -> None:
        text = "extends: fast-cpu\ndepth: {use: files, options: {scale: 2}}\n"
        assert load(text, complete=False).depth.options == {
            "directory": None,
            "scale": 2,
            "weights": {},
        }
        with pytest.raises(ConfigError, match="unknown key"):
            load(text, "depth.options.scael=3", complete=False)

    def test_shipped_configurations_are_listed(self) -> None:
        assert {"default", "fast-cpu", "sensor-depth"} <= shipped_configs().keys()


class TestYaml:
    @pytest.mark.parametrize(
        ("text", "value"),
        [
            ("1e-3", 1e-3),
            ("-2", -2),
            ("0x1f", 31),
            ("010", 10.0),
            (".5", 0.5),
            ("no", "no"),
            ("true", True),
            ("~", None),
            ("", None),
            ("2024-01-01", "2024-01-01"),
            ("1:30", "1:30"),
            ("1.2.3", "1.2.3"),
        ],
    )
    def test_yaml_scalars_follow_version_1_2(self, text: str, value: object) -> None:
        found = parse_yaml(text, "test")
        assert found == value and type(found) is type(value)

    @pytest.mark.parametrize("value", ["1e-3", "no", "null", "", "12", "a: b", "é", 1e-9, None])
    def test_written_yaml_reads_back(self, value: object) -> None:
        assert parse_yaml(write_yaml({"key": value}), "test") == {"key": value}


def sections(options: type[Options]) -> Iterator[tuple[str, type[Options], object]]:
    """Yield name, type and default of every nested section of settings that has a default."""
    for name, field in options.model_fields.items():
        kind = field.annotation
        if isinstance(kind, type) and issubclass(kind, Options) and not field.is_required():
            yield f"{options.__name__}.{name}", kind, field.get_default(call_default_factory=True)
            yield from sections(kind)


@pytest.mark.parametrize(
    ("kind", "default"),
    [pytest.param(kind, default, id=name) for name, kind, default in sections(Config)],
)
def test_partly_set_section_keeps_other_defaults(kind: type[Options], default: object) -> None:
    assert kind() == default
