"""Hash of the source code that computes provider results, as a part of cache keys.

The version of a package does not identify its code if the package is installed in editable mode or
is installed again without a new version. Therefore the source hash covers the files of the package
instead of the package version.
"""

from __future__ import annotations

import functools
import hashlib
import importlib.util
import json
import sys
import time
from collections.abc import Iterator
from importlib import metadata
from pathlib import Path

_STARTED = time.time()
"""Time at which this process imported MP-SfM, in seconds since 1970."""
_MAX_FILE_BYTES = 1 << 20
"""Maximum size of a hashed file; larger files are network weights, whose URI is a separate part of
the cache key."""
_CORE = "mpsfm_core"


def hash_source(module: str) -> str | None:
    """Hash the files of the package that contains a module, without importing the module.

    Args:
        module: Name of a module in the hashed package, such as ``my_depth.model``.

    Returns:
        SHA-256 in hex, or None if a file of the imported package has changed since the start of
        this process. The code in memory may then differ from the files.
    """
    package, root = _find_package(module)
    if root is None:
        return ""
    is_imported = any(name == package or name.startswith(f"{package}.") for name in sys.modules)
    sha256 = hashlib.sha256()
    for path in _source_files(root):
        if is_imported and path.stat().st_mtime > _STARTED:
            return None
        name = path.relative_to(root.parent).as_posix()
        content = path.read_bytes()
        sha256.update(f"{name} {len(content)}\n".encode() + content)
    return sha256.hexdigest()


@functools.cache
def hash_module(module: str) -> str:
    """Return the SHA-256 of the source file of an MP-SfM module, as read at the first call."""
    spec = importlib.util.find_spec(module)
    assert spec is not None and spec.origin is not None
    return hashlib.sha256(Path(spec.origin).read_bytes()).hexdigest()


def hash_requirement(module: str) -> str | None:
    """Return the version of a required package, or its hash if it is installed from a folder.

    Args:
        module: Import name of the package, such as ``kornia``.

    Returns:
        Version of the package without local part such as ``+cpu``, or the result of
        :func:`hash_source`.
    """
    try:
        distribution = metadata.distribution(module)
    except metadata.PackageNotFoundError:
        names = metadata.packages_distributions().get(module, [])
        if not names:
            return hash_source(module)
        distribution = metadata.distribution(names[0])
    origin = distribution.read_text("direct_url.json")
    if origin is not None and "dir_info" in json.loads(origin):
        return hash_source(module)
    return distribution.version.partition("+")[0]


def _find_package(module: str) -> tuple[str, Path | None]:
    """Return the name and the folder or file of the package that contains a module.

    The returned package is the outermost one with an ``__init__.py``, or the innermost one for the
    modules of MP-SfM. The returned path is None for a module without a file.
    """
    parts = module.split(".")
    names = [".".join(parts[:length]) for length in range(1, len(parts) + 1)]
    if parts[0] == _CORE:
        names = names[-2:-1]
    for name in names:
        try:
            spec = importlib.util.find_spec(name)
        except (ImportError, ValueError):
            break
        if spec is not None and spec.origin is not None and spec.has_location:
            origin = Path(spec.origin)
            return name, origin.parent if origin.stem == "__init__" else origin
    return module, None


def _source_files(root: Path) -> Iterator[Path]:
    """Yield all files of a package in a fixed order, without byte code and large files."""
    if not root.is_dir():
        yield root
        return
    for path in sorted(root.rglob("*")):
        is_source = path.is_file() and "__pycache__" not in path.parts
        if is_source and path.stat().st_size <= _MAX_FILE_BYTES:
            yield path
