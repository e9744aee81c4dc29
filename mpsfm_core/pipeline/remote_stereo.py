"""Stereo depth of images on remote workers, such as those of Ray or Dask.

The main process writes poses and refined depth maps to the cache folder. A worker matches one image
with its source images, and writes a checkpoint of the dense stage. The dense stage then finds the
checkpoints of all images. An interrupted run loses at most the images in progress.
"""

from __future__ import annotations

import socket
import uuid
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

from mpsfm_core.data.errors import MpsfmError
from mpsfm_core.dense.densify import DenseViewCache
from mpsfm_core.dense.options import DenseOptions
from mpsfm_core.extraction.executors import finish_items, worker_state
from mpsfm_core.inputs.images import ImageSet
from mpsfm_core.mapping.scene.reconstruction import Reconstruction, RegisteredImage
from mpsfm_core.pipeline.checkpoints import DenseCheckpoints
from mpsfm_core.pipeline.task_inputs import TaskInputs
from mpsfm_core.providers import Executor
from mpsfm_core.support.threads import limit_threads


class RemoteStereo:
    """Computes the stereo depth of the images of one reconstruction on an executor.

    Implements :data:`mpsfm_core.dense.densify.MatchImages`.

    Args:
        executor: Executor whose workers share the cache folder and the images.
        reconstruction: Posed images with refined depth maps.
        step: Function that the workers call for each image.
        progress: Callback that receives the number of finished images and the number of all images.
    """

    def __init__(
        self,
        executor: Executor,
        reconstruction: Reconstruction,
        step: MatchStereo,
        progress: Callable[[int, int], None],
    ) -> None:
        self._executor, self._step, self._progress = executor, step, progress
        self._images = reconstruction.dense_images

    def __call__(self, sources: Mapping[str, Sequence[str]]) -> None:
        """Compute and store the stereo depth of images, with the given source images."""
        inputs = {image.name: self._step.input_key(image.name) for image in self._images}
        try:
            for image in self._images:
                self._step.inputs.store(inputs[image.name], image.state_dict())
            finish_items(
                self._executor.run(self._step, list(sources.items())),
                lambda done: self._progress(done, len(sources)),
            )
        finally:
            for key in inputs.values():
                self._step.inputs.forget(key)


@dataclass(frozen=True)
class MatchStereo:
    """Pickled function that matches an image on any machine, and stores its stereo depth."""

    images: ImageSet
    options: DenseOptions
    checkpoints: DenseCheckpoints
    threads: int
    run: str = field(default_factory=lambda: uuid.uuid4().hex)
    """Identifier of the run; a remote worker caches only the views of its latest run."""

    def __call__(self, item: tuple[str, Sequence[str]]) -> None:
        """Match an image with its source images, unless the checkpoint of the image exists.

        Raises:
            MpsfmError: matching failed; the message names the image.
        """
        name, sources = item
        if self.checkpoints.load(name) is not None:
            return
        with limit_threads(self.threads):
            try:
                depth = worker_state(self.run, self._create_views).match(name, sources)
            except MpsfmError:
                raise
            except Exception as error:
                raise MpsfmError(
                    f"stereo of image {name} failed on {socket.gethostname()}: "
                    f"{type(error).__name__}: {error}"
                ) from error
        self.checkpoints.store(name, depth)

    @property
    def inputs(self) -> TaskInputs:
        """Poses and refined depth maps of the images in the cache folder."""
        return TaskInputs(self.checkpoints.cache, "dense")

    def input_key(self, name: str) -> str:
        """Return the key of an image in :attr:`inputs`."""
        return self.checkpoints.input_key(name)

    def _create_views(self) -> DenseViewCache:
        return DenseViewCache(self._load_image, self.images.view_of, self.options)

    def _load_image(self, name: str) -> RegisteredImage:
        return RegisteredImage.from_state_dict(self.inputs.load(self.input_key(name)))
