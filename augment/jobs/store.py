"""An output folder as a store of whole files: a folder of this machine, or a place in the cloud.

Paths are relative to the folder, with forward slashes. A file is there whole or not at all.
"""

from __future__ import annotations

import contextlib
import importlib
import os
import re
import shutil
import stat
import sys
import tempfile
import threading
import urllib.parse
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from datetime import timedelta
from pathlib import Path
from typing import Any, NamedTuple, Protocol, TypeVar, runtime_checkable

from augment.errors import OutputError
from augment.jobs.atomic import (
    TEMPORARY_SUFFIX,
    copy_file,
    flush_folder,
    link_file,
    make_folder,
    path_below,
    read_file,
    refusals_of,
    write_atomic,
)
from augment.jobs.layout import relative_parts

_UNSAFE = re.compile("[\x00-\x1f\x7f\ud800-\udfff]")  # control characters, bytes that are no text


class StoredFileMissing(OutputError):
    """A store has no file of this path."""


@dataclass(frozen=True)
class StoredFile:
    """Size in bytes, and time of the last change by the store's own clock, seconds since 1970."""

    size: int
    modified_s: float


@runtime_checkable
class Store(Protocol):
    """Files below one folder. All methods raise OutputError, and may be called by any thread. A
    store can be pickled and used after a fork: each process opens its own connections.
    """

    @property
    def uri(self) -> str:
        """What open_store takes, without credentials; a local folder's absolute path."""
        ...

    @property
    def local_dir(self) -> Path | None:
        """The folder, where it is on this machine."""
        ...

    def read(self, path: str) -> bytes:
        """The file's bytes; StoredFileMissing where there is none."""
        ...

    def write(self, path: str, data: bytes) -> None:
        """Put the bytes there, durably, in one step that replaces what was there."""
        ...

    def put_file(self, path: str, source: Path) -> None:
        """As write, with the bytes of a local file; a local store may share its disk blocks."""
        ...

    def list(self, folder: str) -> dict[str, StoredFile]:
        """Every file beneath the folder ("" for all), by path relative to the root, sorted."""
        ...

    def exists(self, path: str) -> bool:
        """Whether there is a file of this path."""
        ...

    def delete(self, paths: Iterable[str]) -> None:
        """Delete files; those that are missing already are fine."""
        ...


def open_store(uri: str | Path) -> Store:
    """The store at a path, `file://`, `s3://bucket/path?region=...`, `gs://` or the like. A folder
    appears with its first file, a bucket must exist. S3 takes the options _S3_OPTIONS in the URI,
    and credentials from the environment. Raises OutputError: no such kind of store, or options that
    it does not know.
    """

    if isinstance(uri, Path) or "://" not in uri:
        return LocalStore(Path(uri).absolute())
    if uri.lower().startswith("file:"):
        parsed = urllib.parse.urlsplit(uri)
        if parsed.netloc not in ("", "localhost") or not parsed.path.startswith("/"):
            raise OutputError(f"{uri!r} must be file:///absolute/path")
        return LocalStore(Path(urllib.parse.unquote(parsed.path)))

    return RemoteStore(uri)


def stored_path(path: str, uri: str) -> str:
    """The path with single slashes between its components."""
    parts = relative_parts(path)
    if parts is None or _UNSAFE.search(path):
        raise OutputError(
            f"{uri}: {path!r} is no path of a file there; paths must be relative to it, with "
            f"forward slashes and without '..' or control characters. Where a manifest names "
            f"it, do not trust the folder"
        )
    return "/".join(parts)


# ---- An output folder on this machine, or on a file system that it has mounted -------------------
# obstore's local store flushes nothing to the disk, makes no hard links of files elsewhere, and its
# temporary names cannot be told from a dead process's; so files are written by `atomic`.

_MAX_RACES = 100  # times that others delete a folder in which a file is just being made


@dataclass(frozen=True)
class LocalStore:
    """Files below the folder `root`, an absolute path; see Store."""

    root: Path

    @property
    def uri(self) -> str:
        return str(self.root)

    @property
    def local_dir(self) -> Path:
        return self.root

    def read(self, path: str) -> bytes:
        file = self._file(path)
        with _reading(file):
            try:
                return read_file(file)
            except (FileNotFoundError, NotADirectoryError):
                raise StoredFileMissing(f"{file} is missing") from None

    def write(self, path: str, data: bytes) -> None:
        file = self._file(path)
        _with_folder(lambda: write_atomic(file, data, clear=False))

    def put_file(self, path: str, source: Path) -> None:
        """A hard link where the system can, else a copy; either way flushed to the disk."""
        self._file(path)
        with _reading(source):
            original = source.resolve(strict=True)
            flush_folder(original)  # or a file
        self.put_files({path: original})

    def put_files(self, files: Mapping[str, Path]) -> None:
        """As put_file, for files that are durable already; each folder is flushed once, at the end.
        files: the local file by its path here.
        """
        placed = {self._file(path): source for path, source in files.items()}
        for file, source in placed.items():
            _with_folder(lambda file=file, source=source: _link_or_copy(source, file))
        for folder in sorted({file.parent for file in placed}):
            with refusals_of(folder):
                flush_folder(folder)

    def list(self, folder: str) -> dict[str, StoredFile]:
        top = self.root if folder == "" else self._file(folder)
        found: dict[str, StoredFile] = {}
        with _reading(top):
            for place, _, names in os.walk(top, onerror=_unless_missing):
                for name in names:
                    file = f"{place}/{name}"
                    with contextlib.suppress(FileNotFoundError):  # deleted since
                        facts = os.stat(file)
                        if stat.S_ISREG(facts.st_mode) and not name.endswith(TEMPORARY_SUFFIX):
                            path = file[len(self.uri) :].lstrip("/")
                            found[path] = StoredFile(facts.st_size, facts.st_mtime)
        return dict(sorted(found.items()))

    def exists(self, path: str) -> bool:
        file = self._file(path)
        with _reading(file):
            return file.is_file()

    def delete(self, paths: Iterable[str]) -> None:
        """Folders that become empty go too, up to the root, which stays."""
        for path in paths:
            file = self._file(path)
            try:
                file.unlink(missing_ok=True)
            except NotADirectoryError:
                continue
            except OSError as error:
                raise OutputError(f"cannot delete {file}: {error.strerror}") from error
            for parent in file.parents:
                if parent == self.root:
                    break
                try:
                    parent.rmdir()
                except FileNotFoundError:
                    continue
                except OSError:  # not empty, or not ours to delete
                    break

    def _file(self, path: str) -> Path:
        return path_below(self.root, tuple(stored_path(path, self.uri).split("/")))


def _unless_missing(error: OSError) -> None:
    if not isinstance(error, FileNotFoundError | NotADirectoryError):
        raise error


def _with_folder(write: Callable[[], None]) -> None:
    """Write again where the file's folder, empty until then, was deleted by others meanwhile."""
    for attempt in range(_MAX_RACES):
        try:
            return write()
        except OutputError as error:
            if not isinstance(error.__cause__, FileNotFoundError) or attempt == _MAX_RACES - 1:
                raise


def _link_or_copy(original: Path, file: Path) -> None:
    with refusals_of(file):
        make_folder(file.parent)
        if not link_file(str(original), str(file)):
            copy_file(str(original), str(file))


@contextlib.contextmanager
def _reading(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise OutputError(
            f"cannot read {path}: {error.strerror}; check that it is a file that this user may read"
        ) from error


# ---- An output folder in the cloud, by obstore ---------------------------------------------------

_GOOGLE, _AZURE = ("gs", "gcs"), ("az", "abfs", "abfss")
_KINDS = ("s3", *_GOOGLE, *_AZURE)
_S3_OPTIONS = ("endpoint_override", "scheme", "region",
               "force_virtual_addressing", "tls_ca_file_path")  # fmt: skip
_ANONYMOUS = "anonymous"  # as the user: requests are not signed
_T = TypeVar("_T")


class _Place(NamedTuple):
    """A URI in parts. public: the URI without its credentials. host: the bucket."""

    public: str
    scheme: str
    host: str
    folder: str
    options: dict[str, str]
    user: str
    password: str


def _parse(uri: str) -> _Place:
    try:
        parsed = urllib.parse.urlsplit(uri)
        options = dict(urllib.parse.parse_qsl(parsed.query, strict_parsing=bool(parsed.query)))
    except ValueError:  # whose text may hold a password
        scheme = uri.partition(":")[0]
        raise OutputError(f"{scheme}://... is no URI of the form kind://bucket/folder") from None
    scheme, (user, _, host) = parsed.scheme, parsed.netloc.rpartition("@")
    user, colon, password = map(urllib.parse.unquote, user.partition(":"))
    if scheme in _AZURE and not colon:  # a container of an account
        user, host = "", parsed.netloc
    at = f"{_ANONYMOUS}@" if user == _ANONYMOUS else ""
    path = parsed.path.rstrip("/")
    public = urllib.parse.urlunsplit((scheme, at + host, path, "", ""))
    folder = urllib.parse.unquote(path).removeprefix("/")
    known = _S3_OPTIONS if scheme == "s3" else ()
    unknown = [name for name in options if name not in known]
    unknown += ["user@"] if user and not at and scheme != "s3" else []
    is_clean = "/".join(relative_parts(folder) or ()) == folder and not _UNSAFE.search(folder)
    problem = ""
    if scheme not in _KINDS:
        problem = (
            f"there are no stores of the kind {scheme!r}; use a path of this machine, or one of "
            f"{', '.join(_KINDS)}"
        )
    elif not host:
        problem = f"the URI names no bucket; expected {scheme}://bucket/folder"
    elif unknown:
        problem = (
            f"there is no option {unknown[0]!r} here; the options are "
            f"{', '.join(known) or 'none'}. Credentials come from the environment "
            f"({_CREDENTIALS[scheme]})"
        )
    elif parsed.fragment or not is_clean:
        problem = (
            "the folder must be named without '.', '..', '#', backslashes and double slashes; "
            "write a sign that has a meaning in URIs as %23 and so on"
        )
    if problem:
        raise OutputError(f"{public}: {problem}")
    query = urllib.parse.urlencode(options)
    return _Place(f"{public}?{query}" if query else public, scheme, host, folder, options,
                  user, password)  # fmt: skip


@dataclass(frozen=True)
class Patience:
    """How failures that pass (timeouts, lost connections, 500, 503) are waited out: so many times,
    each after a longer random wait, for three minutes at most. A request may stand still for
    timeout_s.
    """

    retries: int = 6
    first_wait_s: float = 0.5
    timeout_s: float = 30.0


@dataclass(frozen=True)
class StoredVersion:
    """What an object holds at one moment. mark: tells it from the object's other versions.
    modified_s: see StoredFile; 0 where it is not known.
    """

    data: bytes
    mark: dict[str, str]
    modified_s: float = 0.0


class RemoteStore:
    """Files below a place that a URI names; see Store. An upload is there whole or not at all, and
    its bytes are signed, so a store refuses those that were cut short.
    """

    local_dir = None

    def __init__(self, uri: str, patience: Patience = Patience()) -> None:
        self._place = _parse(uri)
        self.uri = self._place.public
        self.patience = patience
        self._uri = uri
        # By process: what a parent opened is kept, since closing it in a child is not safe.
        self._opened: dict[tuple[int, Patience], Any] = {}

    def __repr__(self) -> str:
        return f"RemoteStore({self.uri!r})"

    def __reduce__(self) -> tuple:
        return (RemoteStore, (self._uri, self.patience))

    def read(self, path: str) -> bytes:
        path = stored_path(path, self.uri)
        return self._call("read", path, lambda obs, at: bytes(obs.get(at, path).bytes()))

    def write(self, path: str, data: bytes) -> None:
        path = stored_path(path, self.uri)
        self._call("write", path, lambda obs, at: obs.put(at, path, data, max_concurrency=4))

    def put_file(self, path: str, source: Path) -> None:
        """The file is read into memory first: one that fails to be read must not be uploaded."""
        stored_path(path, self.uri)
        with _reading(source):
            data = read_file(source)
        self.write(path, data)

    def list(self, folder: str) -> dict[str, StoredFile]:
        path = "" if folder == "" else stored_path(folder, self.uri)
        objects = self._call("list", path, lambda obs, at: obs.list(at, path or None).collect())
        found = {}
        for meta in objects:
            name = meta["path"]
            # Whoever else writes there: what cannot be a path of ours cannot be read either.
            with contextlib.suppress(OutputError):
                if name != path and stored_path(name, self.uri) == name:
                    found[name] = StoredFile(meta["size"], meta["last_modified"].timestamp())
        folders = {name.rpartition("/")[0] for name in found}
        markers = {name for name in folders & found.keys() if found[name].size == 0}
        return {name: found[name] for name in sorted(found.keys() - markers)}

    def exists(self, path: str) -> bool:
        path = stored_path(path, self.uri)
        try:
            self._call("look up", path, lambda obs, at: obs.head(at, path))
        except StoredFileMissing:
            return False
        return True

    def delete(self, paths: Iterable[str]) -> None:
        names = [stored_path(path, self.uri) for path in paths]
        try:
            if names:
                self._call("delete", names[0], lambda obs, at: obs.delete(at, names))
        except StoredFileMissing:  # not of S3: one that is missing hides the others
            for name in names:
                self.delete_once(name)

    def delete_once(self, path: str) -> None:
        """Delete without trying again: of two requests, the second might hit a later object."""
        with contextlib.suppress(StoredFileMissing):
            once = replace(self.patience, retries=0)
            self._call("delete", path, lambda obs, at: obs.delete(at, path), once)

    def read_version(self, path: str) -> StoredVersion | None:
        """What the object holds now; None where there is none."""

        def read(obs: Any, at: Any) -> StoredVersion:
            result = obs.get(at, path)
            modified_s = result.meta["last_modified"].timestamp()
            return StoredVersion(bytes(result.bytes()), _mark(result.meta), modified_s)

        try:
            return self._call("read", path, read)
        except StoredFileMissing:
            return None

    def put_if(self, path: str, data: bytes, there: StoredVersion | None) -> StoredVersion | None:
        """Put the bytes in place of the version `there`, or where there is nothing. Returns what is
        there now: `data`, or what another one has put or deleted meanwhile. data: unlike any that
        were ever there, so that a request whose answer was lost is told from another one's.
        """
        mode = "create" if there is None else there.mark
        for attempts_left in (2, 1, 0):
            is_refused = False
            try:
                put = lambda obs, at: obs.put(at, path, data, mode=mode)  # noqa: E731
                return StoredVersion(data, _mark(self._call("write", path, put)))
            except (_OtherVersionError, StoredFileMissing):
                is_refused = True
            except OutputError:  # obstore does not know whether it arrived
                if attempts_left == 0:
                    raise
            found = self.read_version(path)
            if is_refused or (found is not None and found.data == data):
                return found
        raise AssertionError

    def _call(
        self,
        operation: str,
        path: str,
        call: Callable[[Any, Any], _T],
        patience: Patience | None = None,
    ) -> _T:
        """What the call of obstore returns, at this process's connections."""
        obs, key = _load_obstore(), (os.getpid(), patience or self.patience)
        try:
            if key not in self._opened:
                self._opened[key] = _open(obs, self._place, key[1])
            return call(obs, self._opened[key])
        except OutputError:  # of a file that the URI names
            raise
        except Exception as error:
            cause, base = _cause(error), self.uri.partition("?")[0]
            where = f"{base}/{path}" if path else base
            if isinstance(error, FileNotFoundError) and not _NO_BUCKET.search(cause):
                raise StoredFileMissing(f"{where} is missing") from None
            if type(error).__name__ in ("AlreadyExistsError", "PreconditionError"):
                raise _OtherVersionError from None
            for secret in (self._place.user, self._place.password):
                cause = cause.replace(secret, "***") if secret else cause
            # Without its cause, whose text may hold credentials.
            raise OutputError(
                f"cannot {operation} {where}: {cause}; {_advice(error, cause, self._place.scheme)}"
            ) from None


class _OtherVersionError(OutputError):
    """The object is no longer the version that was to be replaced."""


def _mark(facts: Mapping[str, Any]) -> dict[str, str]:
    return {name: facts[name] for name in ("e_tag", "version") if facts[name] is not None}


def _open(obs: Any, place: _Place, patience: Patience) -> Any:
    """obstore's store of the place."""
    wait = {"init_backoff": timedelta(seconds=patience.first_wait_s)}
    retry = {"max_retries": patience.retries, "backoff": wait}
    client: dict[str, Any] = {
        "read_timeout": timedelta(seconds=patience.timeout_s),
        "timeout": timedelta(days=1),  # of a whole download
    }
    settings: dict[str, Any] = {"client_options": client, "retry_config": retry}
    if place.scheme in _AZURE:
        return obs.store.AzureStore.from_url(place.public, **settings)
    settings["prefix"] = place.folder
    if place.user == _ANONYMOUS:
        settings["skip_signature"] = True
    if place.scheme in _GOOGLE:
        return obs.store.GCSStore(place.host, **settings)
    if place.user not in ("", _ANONYMOUS):
        settings |= {"access_key_id": place.user, "secret_access_key": place.password}
    options = place.options
    if "region" in options:
        settings["region"] = options["region"]
    if "tls_ca_file_path" in options:
        file = Path(options["tls_ca_file_path"])
        with _reading(file):
            client["root_certificate"] = file.read_bytes()
    is_virtual = options.get("force_virtual_addressing", "").lower() in ("true", "1")
    settings["virtual_hosted_style_request"] = is_virtual
    endpoint = os.environ.get("AWS_ENDPOINT_URL_S3") or os.environ.get("AWS_ENDPOINT_URL", "")
    if "endpoint_override" in options:
        scheme, _, host = options["endpoint_override"].rpartition("://")
        bucket = f"{place.host}." if is_virtual else ""
        endpoint = f"{scheme or options.get('scheme', 'https')}://{bucket}{host}"
        settings["aws_endpoint_url_s3"] = endpoint  # which goes before the environment's
    client["allow_http"] = endpoint.startswith("http://")
    # Not every server knows requests that delete many.
    return obs.store.S3Store(place.host, disable_bulk_delete=True, **settings)


_loading = threading.Lock()
_release = _loading.release  # no thread is loading while a process forks
os.register_at_fork(before=_loading.acquire, after_in_parent=_release, after_in_child=_release)
_loaded_by = 0  # this process, or the one that it was forked from
_obstore_folder = ""


def _load_obstore() -> Any:
    """obstore, whose threads do not survive a fork (in a child its calls never return), and which
    it cannot start again: a forked process loads a copy of it under another path.
    """
    global _loaded_by, _obstore_folder
    with _loading:
        if _loaded_by == 0:
            _obstore_folder = str(Path(importlib.import_module("obstore").__file__ or "").parent)
        elif _loaded_by != os.getpid():
            temporary = Path(tempfile.gettempdir())
            with refusals_of(temporary), tempfile.TemporaryDirectory() as folder:
                shutil.copytree(_obstore_folder, f"{folder}/obstore")
                for name in [name for name in sys.modules if name.split(".")[0] == "obstore"]:
                    del sys.modules[name]
                sys.path.insert(0, folder)
                importlib.import_module("obstore")
                sys.path.remove(folder)
        _loaded_by = os.getpid()
    return sys.modules["obstore"]


# ---- What obstore's failures mean, and what to do ------------------------------------------------

_NO_BUCKET = re.compile("NoSuchBucket|bucket does not exist|ContainerNotFound")
_CREDENTIALS = {
    "s3": "AWS_ACCESS_KEY_ID, AWS_SECRET_ACCESS_KEY, AWS_REGION",
    **dict.fromkeys(_GOOGLE, "GOOGLE_APPLICATION_CREDENTIALS"),
    **dict.fromkeys(_AZURE, "AZURE_STORAGE_ACCOUNT_NAME, AZURE_STORAGE_ACCOUNT_KEY"),
}
_ENDPOINT = {"s3": ", the region, and the endpoint (endpoint_override or AWS_ENDPOINT_URL)"}
_ADVICE = {
    "PermissionDenied|Unauthenticated|(?i:credential)|169\\.254\\.|AuthorizationHeaderMalformed"
    "|Account must": ("check {credentials}, and that they may read, write, list and delete there"),
    f"{_NO_BUCKET.pattern}|PermanentRedirect|status code: 30": (
        "check the bucket's name, that it exists{endpoint}"
    ),
    "NotSupported|501 Not Implemented": (
        "the store lacks such requests; claims need puts with If-None-Match and If-Match"
    ),
    "InvalidPath": "delete what others have put there",
    "status code: 4(?!08|29)|known pattern": (
        "the store refuses this for good: check its address and options"
    ),
    "": "check the network{endpoint}, then run the same command again: every file there is whole",
}


def _cause(error: Exception) -> str:
    """The failure without obstore's debugging output; of an answer in XML, its code."""
    text, _, details = str(error).partition("\n\nDebug source")
    text = re.sub(r"<\?xml.*<Code>(.*?)</Code>.*", r"\1", text, flags=re.DOTALL)
    kind = re.search(r"HttpError \{\s*kind: (\w+)", details)
    return " ".join(text.split()) + (f" ({kind[1]})" if kind else "")


def _advice(error: Exception, cause: str, scheme: str) -> str:
    text = f"{type(error).__name__} {cause}"
    advice = next(advice for pattern, advice in _ADVICE.items() if re.search(pattern, text))
    return advice.format(credentials=_CREDENTIALS[scheme], endpoint=_ENDPOINT.get(scheme, ""))
