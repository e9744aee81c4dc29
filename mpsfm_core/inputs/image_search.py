"""Find the images of a folder, read image lists, and report files that cannot be read."""

from __future__ import annotations

import logging
import os
import re
from collections.abc import Iterator
from pathlib import Path, PurePosixPath
from typing import NamedTuple

from mpsfm_core.data.errors import InputError, did_you_mean
from mpsfm_core.data.result_layout import SUMMARY
from mpsfm_core.inputs.captures.convert import find_format
from mpsfm_core.inputs.image_decoding import EXTENSIONS
from mpsfm_core.inputs.text_files import read_text_file
from mpsfm_core.inputs.video import EXTENSIONS as VIDEO_EXTENSIONS
from mpsfm_core.inputs.video import is_video

_log = logging.getLogger(__name__)

MAX_LISTED = 5
"""Maximum number of file names in a message."""
_UNREADABLE = frozenset(
    (".gif", ".jxl", ".psd", ".xcf", ".tga", ".exr", ".hdr", ".insp", ".gpr", ".heics", ".svg")
)
"""Extensions of image formats that no decoder of this package reads."""
_SIGNATURES = (b"\xff\xd8\xff", b"\x89PNG\r\n\x1a\n", b"II*\x00", b"MM\x00*")
"""First bytes of image formats, to recognize image files without extension."""
_THUMBNAIL_FOLDERS = frozenset(("@eaDir", "__MACOSX", "lost+found"))
"""Names of ignored folders that network drives and archive programs create next to images."""
_MASK_MARK = re.compile(r"[_.-]masks?$", re.IGNORECASE)
"""Endings of file stems of masks such as ``X_mask.png`` (OpenDroneMap, Metashape)."""


def find_images(folder: Path, without: Path | None = None) -> list[str]:
    """Find all images in a folder and its subfolders, following symbolic links.

    Hidden files, the subfolder ``without``, and result folders (with a :data:`SUMMARY`) are
    skipped. A warning lists unsupported image formats, and masks of images in the same folder.

    Returns:
        Image names relative to the folder, in natural order.

    Raises:
        InputError: the path does not exist, is not a folder, or is a phone capture with sensor
            depth.
    """
    found = _search_folder(folder, without)
    if found.undecodable:
        _log.warning(
            "files in %s are skipped because their names are not UTF-8: %s; rename these files, "
            "for example with convmv",
            escape(str(folder)),
            escape(list_names(found.undecodable)),
        )
    if found.unread:
        _log.warning(
            "pictures in %s are skipped because their format is not supported: %s; convert the "
            "pictures to JPEG or PNG, with the extension in their names",
            folder,
            list_names(sorted(found.unread, key=_natural_sort_key)),
        )
    if found.masks:
        _log.warning(
            "masks in %s are not reconstructed: %s. To use these masks: --set inputs.masks=%s",
            folder,
            list_names(found.masks),
            folder,
        )
    return found.images


def check_images_folder(folder: Path, without: Path | None = None) -> None:
    """Raise :class:`InputError` if a folder does not exist or has fewer than two images.

    The subfolder ``without`` is skipped. Other than :func:`find_images`, the check gives no
    warnings.
    """
    require_two_images(folder, _search_folder(folder, without).images, folder)


def find_videos(path: Path, without: Path | None = None) -> dict[str, Path]:
    """Find the videos to reconstruct: a single video, or all videos of a folder without images.

    A folder with images is a folder of photos, also if it has videos; phones store a short video
    with each photo.

    Args:
        path: Video or folder.
        without: Subfolder that is skipped.

    Returns:
        Paths of the videos in natural order. The key is the path of a video relative to the folder
        without its extension, and empty for a single video. Empty if there are no videos.

    Raises:
        InputError: the folder does not exist, or two videos differ only in their extensions.
    """
    if is_video(path):
        return {"": path}
    if _search_folder(path, without).images:
        return {}
    names = _list_videos(path, without)
    if len(names) == 1:
        return {"": path / names[0]}
    videos: dict[str, Path] = {}
    for name in names:
        stem = PurePosixPath(name).with_suffix("").as_posix()
        if stem in videos:
            raise InputError(f"{path}: two videos have the name {stem!r}; rename one of them")
        videos[stem] = path / name
    return videos


def _list_videos(folder: Path, without: Path | None) -> list[str]:
    """List the videos below a folder by relative path, in natural order."""
    names = _walk_input_files(folder, without)
    videos = [name for name in names if PurePosixPath(name).suffix.lower() in VIDEO_EXTENSIONS]
    return sorted(videos, key=_natural_sort_key)


def require_two_images(folder: Path, names: list[str], source: Path) -> None:
    """Raise an :class:`InputError` that suggests a next step if there are fewer than two images.

    Args:
        folder: images folder.
        names: names of the images that were found.
        source: path of the image folder or image list, for the message.
    """
    if len(names) >= 2:
        return
    content = f"only one image, {names[0]!r}" if names else "no images"
    if videos := _list_videos(folder, None):
        raise InputError(
            f"{source} has {content}, but {_count(len(videos), 'video', 'videos')}, such as "
            f"{videos[0]!r}. Give one video instead, or a folder that has only videos: "
            f"mpsfm reconstruct '{folder / videos[0]}'"
        )
    raise InputError(f"{source} has {content}: a reconstruction needs two or more images")


def check_output_folder(output: Path, folder: Path) -> None:
    """Raise :class:`InputError` if ``output`` is the images folder or a subfolder with images."""
    if not is_utf8(str(output)):
        raise InputError(
            f"the name of the output folder {escape(str(output))} is not UTF-8; choose another name"
        )
    if output.resolve() == folder.resolve():
        raise InputError(
            f"{output} is the folder of the photos, and results must not be mixed with photos. "
            f"Choose another output folder, such as {output / 'reconstruction'}"
        )
    inside = _find_below(output, folder)
    if inside is None or not inside.is_dir() or (inside / SUMMARY).is_file():
        return
    if photos := find_images(inside):
        raise InputError(
            f"{output} is a subfolder of the photos and has "
            f"{_count(len(photos), 'photo', 'photos')}, such as {photos[0]}. "
            f"Results must not be mixed with photos; choose another output folder"
        )


def read_image_list(path: Path) -> list[str]:
    """Read an image list, a text file with one image name per line and ``#`` comments.

    Raises:
        InputError: the image list cannot be read.
    """
    try:
        lines = read_text_file(path).splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"image list {path} cannot be read: {error}") from error
    return [line.strip() for line in lines if line.strip() and not line.lstrip().startswith("#")]


def select_listed_images(image_list: Path, names: list[str], folder: Path) -> list[str]:
    """Read an image list and check its names; keep their order.

    Raises:
        InputError: an image name is listed twice or is not among ``names``.
    """
    listed = read_image_list(image_list)
    available, seen = set(names), set()
    for name in listed:
        if name in seen:
            raise InputError(f"{image_list}: image {name!r} is listed twice")
        if name not in available:
            near = did_you_mean(name, names) if len(names) <= 1000 else ""
            raise InputError(f"{image_list}: there is no image {name!r} in {folder}{near}")
        seen.add(name)
    return listed


def walk_files(folder: Path) -> Iterator[str]:
    """Yield relative paths of all files below a folder, except hidden files and thumbnails.

    Symbolic links to folders are followed. A folder that several links reach is read once.
    """
    visited: set[tuple[int, int]] = set()
    for parent, folders, files in os.walk(folder, followlinks=True):
        status = Path(parent).stat()
        if (status.st_dev, status.st_ino) in visited:
            folders.clear()
            continue
        visited.add((status.st_dev, status.st_ino))
        # Real folders are visited before symbolic links, so that links do not change image names.
        visible = [n for n in folders if not n.startswith(".") and n not in _THUMBNAIL_FOLDERS]
        folders[:] = [
            name for _, name in sorted((Path(parent, n).is_symlink(), n) for n in visible)
        ]
        for name in sorted(files):
            path = Path(parent, name)
            if not name.startswith(".") and path.is_file():
                yield path.relative_to(folder).as_posix()


def is_utf8(name: str) -> bool:
    """Return whether a file name is valid UTF-8, as COLMAP and JSON files require."""
    try:
        name.encode("utf-8")
    except UnicodeEncodeError:
        return False
    return True


def escape(name: str) -> str:
    r"""Replace bytes of a file name that are not UTF-8 by ``\xNN``."""
    return os.fsencode(name).decode("utf-8", "backslashreplace")


def list_names(names: list[str]) -> str:
    """Join at most :data:`MAX_LISTED` file names for a message."""
    rest = len(names) - MAX_LISTED
    return ", ".join(names[:MAX_LISTED]) + (f" and {rest} more" if rest > 0 else "")


class _FolderContent(NamedTuple):
    """Names of the files in a folder by their use."""

    images: list[str]
    masks: list[str]
    unread: list[str]
    """Images of unsupported formats."""
    undecodable: list[str]
    """Files whose names are not UTF-8."""


def _search_folder(folder: Path, without: Path | None) -> _FolderContent:
    """List the files in a folder of images; raise :class:`InputError` if it is none."""
    if (capture := find_format(folder)) is not None:
        raise InputError(
            f"{folder} is a capture of {capture.name}; convert the capture first: "
            f"mpsfm import '{folder}' --output DIR"
        )
    if not folder.is_dir():
        if folder.exists():
            raise InputError(
                f"{folder} is neither a folder of photos nor a video; give one of the two"
            )
        raise InputError(f"images folder {folder} does not exist")
    names, unread, undecodable = [], [], []
    for name in _walk_input_files(folder, without):
        if not is_utf8(name):
            undecodable.append(name)
            continue
        extension = PurePosixPath(name).suffix.lower()
        if extension in EXTENSIONS:
            names.append(name)
        elif extension in _UNREADABLE or (not extension and _has_signature(folder / name)):
            unread.append(name)
    names = sorted(names, key=_natural_sort_key)
    masks = _find_mask_names(names)
    excluded = frozenset(masks)
    images = [name for name in names if name not in excluded]
    return _FolderContent(images, masks, unread, undecodable)


def _walk_input_files(folder: Path, without: Path | None) -> Iterator[str]:
    """Yield the files below a folder, skipping the subfolder ``without`` and result folders."""
    skipped = _find_below(without, folder)
    results: dict[Path, bool] = {}

    def is_skipped(parent: Path) -> bool:
        if parent not in results:
            results[parent] = parent == skipped or (parent / SUMMARY).is_file()
        return results[parent]

    for name in walk_files(folder):
        parents = [folder / parent for parent in PurePosixPath(name).parents][:-1]
        if not any(map(is_skipped, parents)):
            yield name


def _find_mask_names(names: list[str]) -> list[str]:
    """Return names of mask files such as ``X_mask.png`` whose image ``X`` is in the same folder."""
    stems = {str(PurePosixPath(name).with_suffix("")).casefold() for name in names}
    stems |= {name.casefold() for name in names}
    masks = []
    for name in names:
        stem = str(PurePosixPath(name).with_suffix("")).casefold()
        image = _MASK_MARK.sub("", stem)
        if image != stem and image in stems:
            masks.append(name)
    return masks


def _has_signature(path: Path) -> bool:
    try:
        with path.open("rb") as file:
            return file.read(8).startswith(_SIGNATURES)
    except OSError:
        return False


def _find_below(inner: Path | None, folder: Path) -> Path | None:
    """Return ``inner`` as a path that starts with ``folder``, None if not below ``folder``."""
    if inner is None or not inner.resolve().is_relative_to(folder.resolve()):
        return None
    return folder / inner.resolve().relative_to(folder.resolve())


def _natural_sort_key(name: str) -> list[tuple[int, int, str]]:
    """Return a key that sorts ``img2`` before ``img10``."""
    parts = re.split(r"(\d+)", name)
    return [(1, int(p), p) if p.isdecimal() else (0, 0, p) for p in parts]


def _count(number: int, one: str, several: str) -> str:
    return f"{number} {one if number == 1 else several}"
