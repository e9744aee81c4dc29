"""The configuration of a run as one immutable, typed object."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal

from pydantic import Field, PrivateAttr

from mpsfm_core.config.settings import user_settings
from mpsfm_core.data.options import Options, SettingPath, expert
from mpsfm_core.dense.options import DenseOptions
from mpsfm_core.extraction.options import (
    AdjustmentOptions,
    ExtractionOptions,
    PairOptions,
    VerificationOptions,
)
from mpsfm_core.inputs.options import InputOptions
from mpsfm_core.mapping.options import MapperOptions, MappingOptions
from mpsfm_core.providers import Kind
from mpsfm_core.providers.provider_config import ProviderConfig
from mpsfm_core.results.options import ResultOptions
from mpsfm_core.support.format_versions import VERSION
from mpsfm_core.support.yaml_text import write_yaml

FORMAT = 1
"""Version number of the format of configuration files."""


class RuntimeOptions(Options):
    """Options of the computation: workers, device, cache, executor, error handling.

    Of the runtime options, only the seed changes the results. Results of networks may differ by
    rounding between devices and thread counts. Cached results are valid on all devices.
    """

    workers: int | None = Field(None, ge=1)
    """Number of images or pairs that extraction and the dense stage process in parallel. More
    workers are faster and need more memory. If ``workers`` is null, one worker per core runs, at
    most four in extraction."""
    threads: int = expert(1, ge=1)
    """Number of threads of a provider per worker. If ``workers`` is null, providers also use the
    cores that no worker occupies."""
    seed: int = Field(0, ge=0)
    """Seed of every random choice: providers, verification, mapper, points of ``dense.ply``."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Device on which providers run, where ``auto`` uses a GPU if one is available."""
    cache_dir: Path | None = None
    """Folder of network weights, extraction results and checkpoints, by default the platform's
    cache folder."""
    executor: str = "threads"
    """Executor of providers, mapping in parts and stereo, either ``threads`` of this process or the
    workers of a plugin (``dask``, ``ray``), which share ``cache_dir`` and the images."""
    executor_options: dict[str, Any] = expert({})
    """Options of the executor plugin, such as ``address`` of a Dask scheduler."""
    on_error: Literal["fail", "skip"] = "fail"
    """Reaction to a provider that fails on an image or pair, where ``fail`` ends the run and
    ``skip`` continues without the image or pair. Failures of more than half of the images always
    end the run."""
    timeout_s: float | None = expert(1800.0, gt=0)
    """Maximum seconds that a provider may take per image or pair; null sets no limit."""
    checkpoint_s: float | None = expert(10.0, ge=0)
    """Minimum seconds between checkpoints of mapping. If ``checkpoint_s`` is null, mapping and the
    dense stage write no checkpoints."""
    check_resources: bool = expert(True)
    """Use fewer workers if memory is short, and refuse a run that cannot fit into memory or onto
    the disk."""
    offline: bool = False
    """If true, never download weights; missing weights are an error."""


class FastPass(Options):
    """Inexpensive features and sparse matcher for a first matching and mapping pass.

    The blocks ``features`` and ``matcher`` then match only pairs with an image that observes fewer
    than 100 points.
    """

    features: ProviderConfig
    matcher: ProviderConfig
    partners: int = expert(15, ge=1)
    """Value of ``pairs.partners`` for images that are matched again, unless all pairs are matched.
    A larger number of partners takes more time. [tuned: benchmarks.pairs]"""


class Config(Options):
    """All settings of a run, except input images and output folder."""

    description: str = ""
    """Description of the configuration for ``mpsfm config list``; not inherited."""
    inputs: InputOptions = Field(default_factory=InputOptions)
    pairs: PairOptions = Field(default_factory=PairOptions)
    fast_pass: FastPass | None = None
    """First, inexpensive pass of matching and mapping. If ``fast_pass`` is null, ``matcher``
    matches all pairs."""
    features: ProviderConfig | None = None
    matcher: ProviderConfig | None = None
    """Matcher of sparse features; requires the block ``features``."""
    dense_matcher: ProviderConfig | None = None
    """Detector-free matcher, instead of or in addition to the sparse matcher."""
    retrieval: ProviderConfig | None = None
    multiview: ProviderConfig | None = None
    """Multi-view network that predicts depth for groups of images, needed by ``depth: {use:
    multiview}``."""
    camera: ProviderConfig | None = None
    """Camera provider, which estimates the focal lengths of photos without calibration. If
    ``camera`` is null, a depth provider with ``estimates-focal`` estimates those of photos without
    EXIF."""
    depth: ProviderConfig
    normals: ProviderConfig
    """Provider of normals; With ``use: same-network``, the depth network also predicts the
    normals."""
    masks: tuple[ProviderConfig, ...] = ()
    """Mask providers. Providers of masks; a pixel is used if no mask excludes the pixel."""
    verification: VerificationOptions = Field(default_factory=VerificationOptions)
    adjustment: AdjustmentOptions = Field(default_factory=AdjustmentOptions)
    extraction: ExtractionOptions = Field(default_factory=ExtractionOptions)
    mapping: MappingOptions = Field(default_factory=MappingOptions)
    dense: DenseOptions = Field(default_factory=DenseOptions)
    results: ResultOptions = Field(default_factory=ResultOptions)
    runtime: RuntimeOptions = Field(default_factory=RuntimeOptions)
    _warnings: tuple[str, ...] = PrivateAttr(())

    @property
    def warnings(self) -> tuple[str, ...]:
        """Warnings about side effects of the configuration files, such as a dropped fast pass."""
        return self._warnings

    def with_warnings(self, warnings: tuple[str, ...]) -> Config:
        """Return a copy of the configuration with the given warnings."""
        config = self.model_copy()
        config._warnings = warnings
        return config

    def provider_configs(self) -> Iterator[tuple[SettingPath, Kind, ProviderConfig]]:
        """Yield YAML path, provider kind and block of every named provider."""
        if self.fast_pass is not None:
            yield ("fast_pass", "features"), "features", self.fast_pass.features
            yield ("fast_pass", "matcher"), "matcher", self.fast_pass.matcher
        for name, kind in PROVIDER_BLOCKS.items():
            block = getattr(self, name)
            if block is not None:
                yield (name,), kind, block
        for index, block in enumerate(self.masks):
            yield ("masks", index), "mask", block

    def replaced(self, path: SettingPath, block: ProviderConfig) -> Config:
        """Return a copy of the configuration with another provider block at a path."""
        name, *keys = path
        value: Any = block
        if name == "fast_pass" and self.fast_pass is not None:
            value = self.fast_pass.model_copy(update={str(keys[0]): block})
        elif keys:
            value = tuple(block if i == keys[0] else mask for i, mask in enumerate(self.masks))
        return self.model_copy(update={str(name): value})

    def fast_pass_config(self) -> Config | None:
        """Return the configuration of the fast pass alone, or None without a fast pass."""
        if self.fast_pass is None:
            return None
        update = {"fast_pass": None, "dense_matcher": None, **dict(self.fast_pass)}
        return self.model_copy(update=update)

    @property
    def has_second_pass(self) -> bool:
        """True if ``features`` and ``matcher`` run after the fast pass.

        If ``features`` is the provider of the fast pass, a second pass would detect the same
        features again and is skipped.
        """
        if self.fast_pass is None:
            return False
        same_features = (
            self.features is not None and self.features.use == self.fast_pass.features.use
        )
        return self.dense_matcher is not None or not same_features

    def mapper_options(self) -> MapperOptions:
        """Return the options of the mapper, with the seed of the run."""
        return MapperOptions(**dict(self.mapping), seed=self.runtime.seed)

    def to_yaml(self, *, expert_settings: bool = True) -> str:
        """Format the configuration as YAML with all defaults.

        Args:
            expert_settings: If false, omit expert settings that have their default value.
        """
        values = self.model_dump(mode="json") if expert_settings else user_settings(self)
        return write_yaml({VERSION: FORMAT, **values})


PROVIDER_BLOCKS: dict[str, Kind] = {
    "features": "features",
    "matcher": "matcher",
    "dense_matcher": "matcher",
    "retrieval": "retrieval",
    "camera": "camera",
    "multiview": "multiview",
    "depth": "depth",
    "normals": "normals",
}
"""Configuration blocks that name one provider, with the kind of this provider."""

BLOCKS = ("fast_pass", *PROVIDER_BLOCKS, "masks")
"""Configuration blocks that name providers, in the order of provider resolution."""
