"""The options of a run as one immutable, typed object."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal

from pydantic import Field

from mpsfm_core.data.options import Options, SettingPath
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
"""Of configuration files."""


class RuntimeOptions(Options):
    """Where and how a run computes; nothing here changes what it computes but the seed.

    That is up to rounding: networks may add in another order on other devices and thread counts.
    What is cached stands, whatever made it.
    """

    workers: int | None = Field(None, ge=1)
    """Images or pairs that the extraction works on at once, null for one a core."""
    threads: int = Field(1, ge=1)
    """Threads that a provider may use for each of them."""
    seed: int = Field(0, ge=0)
    """Seed of everything random: providers, verification, mapper, pixels of ``dense.ply``."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Where providers compute; ``auto`` takes a GPU when there is one."""
    cache_dir: Path | None = None
    """Folder of weights and extraction results, null for the platform's cache folder."""
    executor: str = "threads"
    """Where features, matches and priors are computed: ``threads`` of this process, or workers that
    a plugin reaches (``dask``, ``ray``) and that share ``cache_dir`` and the photos."""
    executor_options: dict[str, Any] = Field(default_factory=dict)
    """Of the executor, as ``address``."""
    on_error: Literal["fail", "skip"] = "fail"
    """A provider that fails on a photo (raises, breaks its contract, does not answer) ends the run,
    or the run goes on without that photo, or without that pair, and says so. More than half of the
    photos end it in any case."""
    timeout_s: float | None = Field(1800.0, gt=0)
    """Seconds that a provider may take for one photo or pair, null for any time."""
    checkpoint_s: float | None = Field(10.0, ge=0)
    """Seconds between checkpoints of the mapping, more where writing one takes long; a run that
    was killed goes on from the last. Null writes none, and none of the dense stage either."""
    check_resources: bool = True
    """A run that cannot fit into memory or onto the disk ends before a photo is decoded, and one
    that may not fit says so; off: what it takes is told and no more."""
    offline: bool = False
    """Never download; a missing weights file is an error."""


class FastPass(Options):
    """Features and a sparse matcher that cost little."""

    features: ProviderConfig
    matcher: ProviderConfig
    min_points: int = Field(100, ge=1)
    """An image is held in place by so many points that three images see. (COLMAP's
    init_min_num_inliers, what it takes to begin a model. Ours: images of fountain and
    rendered_kitchen see 321 and more; two triplets of hololens_room with 35 and 72 were wrong by 45
    and 5 degrees where the networks are right to 2.)"""
    partners: int = Field(15, ge=1)
    """``pairs.partners`` of images that are matched again, where not all pairs are. (Ours, of 26 of
    the 123 images of hololens_room: with 30, 15 and 10 partners networks match 641, 313 and 216
    pairs, pose AUC@1/5/20 is 6.4 / 51.2 / 85.2, 7.3 / 49.6 / 85.2 and 5.1 / 54.1 / 87.5.)"""


class Config(Options):
    """Everything a run needs to know besides its images and output folder."""

    description: str = ""
    """One line for ``mpsfm config list``; not inherited."""
    inputs: InputOptions = Field(default_factory=InputOptions)
    pairs: PairOptions = Field(default_factory=PairOptions)
    fast_pass: FastPass | None = None
    """Matching that is tried first: photos that it holds in place are not given to ``features`` and
    ``matcher`` again, pairs with others are (:mod:`mpsfm_core.pipeline.run`)."""
    features: ProviderConfig | None = None
    matcher: ProviderConfig | None = None
    """Sparse matcher, needs ``features``."""
    dense_matcher: ProviderConfig | None = None
    """Detector-free matcher, instead of the sparse one or beside it."""
    retrieval: ProviderConfig | None = None
    multiview: ProviderConfig | None = None
    """Network that sees several photos at once, needed by ``depth: {use: multiview}``."""
    depth: ProviderConfig
    normals: ProviderConfig
    """Of the depth network's own pass with ``use: same-network``, if that gives normals."""
    masks: tuple[ProviderConfig, ...] = ()
    """A pixel is used when all masks allow it."""
    verification: VerificationOptions = Field(default_factory=VerificationOptions)
    adjustment: AdjustmentOptions = Field(default_factory=AdjustmentOptions)
    extraction: ExtractionOptions = Field(default_factory=ExtractionOptions)
    mapping: MappingOptions = Field(default_factory=MappingOptions)
    dense: DenseOptions = Field(default_factory=DenseOptions)
    results: ResultOptions = Field(default_factory=ResultOptions)
    runtime: RuntimeOptions = Field(default_factory=RuntimeOptions)

    def provider_configs(self) -> Iterator[tuple[SettingPath, Kind, ProviderConfig]]:
        """Every chosen provider: its path in the configuration, kind and block."""
        if self.fast_pass is not None:
            yield ("fast_pass", "features"), "features", self.fast_pass.features
            yield ("fast_pass", "matcher"), "matcher", self.fast_pass.matcher
        for name, kind in PROVIDER_BLOCKS.items():
            backend = getattr(self, name)
            if backend is not None:
                yield (name,), kind, backend
        for index, backend in enumerate(self.masks):
            yield ("masks", index), "mask", backend

    def replaced(self, path: SettingPath, backend: ProviderConfig) -> Config:
        """The configuration with another backend at a path of :meth:`provider_configs`."""
        block, *index = path
        value: Any = backend
        if block == "fast_pass" and self.fast_pass is not None:
            value = self.fast_pass.model_copy(update={str(index[0]): backend})
        elif index:
            value = tuple(backend if i == index[0] else b for i, b in enumerate(self.masks))
        return self.model_copy(update={str(block): value})

    def fast_pass_config(self) -> Config | None:
        """The configuration with its quick matching alone, None where it has none."""
        if self.fast_pass is None:
            return None
        alone = {"fast_pass": None, "dense_matcher": None, **dict(self.fast_pass)}
        return self.model_copy(update=alone)

    @property
    def has_second_pass(self) -> bool:
        """Whether quick matching is followed by another one where it does not suffice; not where
        the other's first choice cannot be had and the same features would be found again."""
        if self.fast_pass is None:
            return False
        again = self.features is not None and self.features.use == self.fast_pass.features.use
        return self.dense_matcher is not None or not again

    def mapper_options(self) -> MapperOptions:
        """The settings of the mapper, with the seed of the run."""
        return MapperOptions(**dict(self.mapping), seed=self.runtime.seed)

    def to_yaml(self) -> str:
        """The configuration with all defaults; loading it gives the same configuration."""
        return write_yaml({VERSION: FORMAT, **self.model_dump(mode="json")})


PROVIDER_BLOCKS: dict[str, Kind] = {
    "features": "features",
    "matcher": "matcher",
    "dense_matcher": "matcher",
    "retrieval": "retrieval",
    "multiview": "multiview",
    "depth": "depth",
    "normals": "normals",
}

BLOCKS = ("fast_pass", *PROVIDER_BLOCKS, "masks")
"""The blocks that name providers, each after those that its choice depends on."""
