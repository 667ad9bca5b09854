"""Store of an output's files: a folder of this machine, or a place in an object store.

In: a path or URI (`open_store`). Out: a `Store` that reads and writes complete files. Jobs, readers
of outputs and `tools` use it. Paths are relative to the output folder, with forward slashes. A file
is complete or absent.
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
from augment.output.atomic import (
    TEMPORARY_SUFFIX,
    copy_file,
    flush_folder,
    link_file,
    make_folder,
    path_below,
    raise_output_error,
    read_file,
    write_atomic,
)
from augment.output.names import relative_parts

# Control characters, and bytes that are not text.
_UNSAFE_CHARACTERS = re.compile("[\x00-\x1f\x7f\ud800-\udfff]")


class StoredFileMissing(OutputError):
    """Error of a store that has no file of this path."""


@dataclass(frozen=True)
class StoredFile:
    """Facts of a stored file."""

    size: int
    """Size in bytes."""
    modified_s: float
    """Time of the last change by the store's own clock, seconds since 1970."""


@runtime_checkable
class Store(Protocol):
    """Files below one folder.

    All methods raise OutputError, and may be called by any thread. A store can be pickled and used
    after a fork, because each process opens its own connections.
    """

    @property
    def uri(self) -> str:
        """URI for open_store, without credentials; the absolute path of a local folder."""
        ...

    @property
    def local_dir(self) -> Path | None:
        """Folder of the store, if it is on this machine; None otherwise."""
        ...

    def read(self, path: str) -> bytes:
        """Return the file's bytes; raise StoredFileMissing where there is none."""
        ...

    def write(self, path: str, data: bytes) -> None:
        """Write the bytes durably, replacing an earlier file in one step."""
        ...

    def put_file(self, path: str, source: Path) -> None:
        """Write the bytes of a local file; a local store may share its disk blocks."""
        ...

    def list(self, folder: str) -> dict[str, StoredFile]:
        """Return every file beneath the folder, by path relative to the root, sorted.

        The folder "" stands for all.
        """
        ...

    def exists(self, path: str) -> bool:
        """Return True if there is a file of this path."""
        ...

    def delete(self, paths: Iterable[str]) -> None:
        """Delete files; missing ones are no error."""
        ...


def open_store(uri: str | Path) -> Store:
    """Return the store at a path, `file://`, `s3://bucket/path?region=...`, `gs://` or the like.

    A folder appears with its first file; a bucket must exist. S3 takes the options _S3_OPTIONS in
    the URI, and credentials from the environment.

    Raises:
        OutputError: There is no such kind of store, or it does not know an option.
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
    """Return the path with single slashes between its components.

    Raises:
        OutputError: The path is not one below the root.
    """
    parts = relative_parts(path)
    if parts is None or _UNSAFE_CHARACTERS.search(path):
        raise OutputError(
            f"{uri}: {path!r} is no path of a file there; paths must be relative to it, with "
            f"forward slashes and without '..' or control characters. Where a manifest names "
            f"it, do not trust the folder"
        )
    return "/".join(parts)


# ---- An output folder on this machine, or on a file system that it has mounted -------------------
# obstore's local store flushes nothing to the disk, makes no hard links of files elsewhere, and
# does not show whether a temporary file belongs to a dead process; so `atomic` writes the files.

# Times that other processes may delete a folder in which a file is just being made.
_MAX_RACES = 100


@dataclass(frozen=True)
class LocalStore:
    """Files below a folder; see Store."""

    root: Path
    """Absolute path of the folder."""

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
        _retry_write(lambda: write_atomic(file, data, clear=False))

    def put_file(self, path: str, source: Path) -> None:
        """Make a hard link where the system can, otherwise a copy; flush it to the disk."""
        self._file(path)
        with _reading(source):
            original = source.resolve(strict=True)
            flush_folder(original)  # flushes a file's bytes too
        self.put_files({path: original})

    def put_files(self, files: Mapping[str, Path]) -> None:
        """Put files that are durable already; each folder is flushed once, at the end.

        Args:
            files: Local file by its path in the store.
        """
        source_of_target = {self._file(path): source for path, source in files.items()}
        for file, source in source_of_target.items():
            _retry_write(lambda file=file, source=source: _link_or_copy(source, file))
        for folder in sorted({file.parent for file in source_of_target}):
            with raise_output_error(folder):
                flush_folder(folder)

    def list(self, folder: str) -> dict[str, StoredFile]:
        top_dir = self.root if folder == "" else self._file(folder)
        files: dict[str, StoredFile] = {}
        with _reading(top_dir):
            for folder_path, _, names in os.walk(top_dir, onerror=_unless_missing):
                for name in names:
                    file = f"{folder_path}/{name}"
                    with contextlib.suppress(FileNotFoundError):  # deleted meanwhile
                        facts = os.stat(file)
                        if stat.S_ISREG(facts.st_mode) and not name.endswith(TEMPORARY_SUFFIX):
                            path = file[len(self.uri) :].lstrip("/")
                            files[path] = StoredFile(facts.st_size, facts.st_mtime)
        return dict(sorted(files.items()))

    def exists(self, path: str) -> bool:
        file = self._file(path)
        with _reading(file):
            return file.is_file()

    def delete(self, paths: Iterable[str]) -> None:
        """Delete files, and folders that become empty, except the root."""
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
    """Raise an error, unless it says that a file or folder is missing."""
    if not isinstance(error, FileNotFoundError | NotADirectoryError):
        raise error


def _retry_write(write: Callable[[], None]) -> None:
    """Write again where another process deleted the file's folder, empty until then, meanwhile."""
    for attempt in range(_MAX_RACES):
        try:
            return write()
        except OutputError as error:
            if not isinstance(error.__cause__, FileNotFoundError) or attempt == _MAX_RACES - 1:
                raise


def _link_or_copy(original: Path, file: Path) -> None:
    """Link or copy a file into the store."""
    with raise_output_error(file):
        make_folder(file.parent)
        if not link_file(str(original), str(file)):
            copy_file(str(original), str(file))


@contextlib.contextmanager
def _reading(path: Path) -> Iterator[None]:
    """Context manager that turns errors of reading a file into an OutputError."""
    try:
        yield
    except OSError as error:
        raise OutputError(
            f"cannot read {path}: {error.strerror}; check that it is a file that this user may read"
        ) from error


# ---- An output folder in an object store, by obstore ---------------------------------------------

# Schemes of Google Cloud Storage.
_GOOGLE_SCHEMES = ("gs", "gcs")
# Schemes of Azure Blob Storage.
_AZURE_SCHEMES = ("az", "abfs", "abfss")
# Schemes of all stores.
_SCHEMES = ("s3", *_GOOGLE_SCHEMES, *_AZURE_SCHEMES)
# Options of an S3 URI.
_S3_OPTIONS = (
    "endpoint_override",
    "scheme",
    "region",
    "force_virtual_addressing",
    "tls_ca_file_path",
)
# User whose requests are not signed.
_ANONYMOUS = "anonymous"
_T = TypeVar("_T")


class _Place(NamedTuple):
    """Parts of a URI."""

    public: str
    """The URI without its credentials."""
    scheme: str
    """Kind of store."""
    host: str
    """Name of the bucket."""
    folder: str
    """Folder in the bucket."""
    options: dict[str, str]
    """Options of the URI."""
    user: str
    """User, or access key; may be empty."""
    password: str
    """Password, or secret key; may be empty."""


def _parse(uri: str) -> _Place:
    """Return the parts of a URI; raise OutputError where it is wrong."""
    try:
        parsed = urllib.parse.urlsplit(uri)
        options = dict(urllib.parse.parse_qsl(parsed.query, strict_parsing=bool(parsed.query)))
    except ValueError:  # its text may hold a password
        scheme = uri.partition(":")[0]
        raise OutputError(f"{scheme}://... is no URI of the form kind://bucket/folder") from None
    scheme = parsed.scheme
    (user, _, host) = parsed.netloc.rpartition("@")
    user, colon, password = map(urllib.parse.unquote, user.partition(":"))
    if scheme in _AZURE_SCHEMES and not colon:  # the URI names a container of an account
        user = ""
        host = parsed.netloc
    user_prefix = f"{_ANONYMOUS}@" if user == _ANONYMOUS else ""
    path = parsed.path.rstrip("/")
    public = urllib.parse.urlunsplit((scheme, user_prefix + host, path, "", ""))
    folder = urllib.parse.unquote(path).removeprefix("/")
    known_options = _S3_OPTIONS if scheme == "s3" else ()
    unknown_options = [name for name in options if name not in known_options]
    unknown_options += ["user@"] if user and not user_prefix and scheme != "s3" else []
    is_clean = "/".join(relative_parts(folder) or ()) == folder and not _UNSAFE_CHARACTERS.search(
        folder
    )
    problem = ""
    if scheme not in _SCHEMES:
        problem = (
            f"there are no stores of the kind {scheme!r}; use a path of this machine, or one of "
            f"{', '.join(_SCHEMES)}"
        )
    elif not host:
        problem = f"the URI names no bucket; expected {scheme}://bucket/folder"
    elif unknown_options:
        problem = (
            f"there is no option {unknown_options[0]!r} here; the options are "
            f"{', '.join(known_options) or 'none'}. Credentials come from the environment "
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
    return _Place(
        f"{public}?{query}" if query else public, scheme, host, folder, options, user, password
    )


@dataclass(frozen=True)
class RetrySettings:
    """How passing failures (timeouts, lost connections, 500, 503) are waited out.

    Each retry comes after a longer random wait; all of them end after three minutes at most.
    """

    retries: int = 6
    """Number of retries."""
    first_wait_s: float = 0.5
    """Wait before the first retry, seconds."""
    timeout_s: float = 30.0
    """Longest time for which a request may stand still, seconds."""


@dataclass(frozen=True)
class StoredVersion:
    """Content of an object at one moment."""

    data: bytes
    """Bytes of the object."""
    mark: dict[str, str]
    """Marks that differ between the object's versions."""
    modified_s: float = 0.0
    """As of StoredFile; 0 where it is not known."""


class RemoteStore:
    """Files below a place that a URI names; see Store.

    An upload is complete or absent. Its bytes are signed, so a store refuses uploads that were cut
    short.
    """

    local_dir = None

    def __init__(self, uri: str, retry_settings: RetrySettings = RetrySettings()) -> None:
        self._place = _parse(uri)
        self.uri = self._place.public
        self.retry_settings = retry_settings
        self._uri = uri
        # Connections by process: a parent's are kept, because closing them in a child is not safe.
        self._connections: dict[tuple[int, RetrySettings], Any] = {}

    def __repr__(self) -> str:
        return f"RemoteStore({self.uri!r})"

    def __reduce__(self) -> tuple:
        return (RemoteStore, (self._uri, self.retry_settings))

    def read(self, path: str) -> bytes:
        path = stored_path(path, self.uri)
        return self._call(
            "read", path, lambda obs, connection: bytes(obs.get(connection, path).bytes())
        )

    def write(self, path: str, data: bytes) -> None:
        path = stored_path(path, self.uri)
        self._call(
            "write",
            path,
            lambda obs, connection: obs.put(connection, path, data, max_concurrency=4),
        )

    def put_file(self, path: str, source: Path) -> None:
        """Write the bytes of a local file.

        The file is read into memory first, so that no file is uploaded that cannot be read.
        """
        stored_path(path, self.uri)
        with _reading(source):
            data = read_file(source)
        self.write(path, data)

    def list(self, folder: str) -> dict[str, StoredFile]:
        path = "" if folder == "" else stored_path(folder, self.uri)
        objects = self._call(
            "list", path, lambda obs, connection: obs.list(connection, path or None).collect()
        )
        files = {}
        for facts in objects:
            name = facts["path"]
            # Other programs may write there; a name that cannot be our path cannot be read either.
            with contextlib.suppress(OutputError):
                if name != path and stored_path(name, self.uri) == name:
                    files[name] = StoredFile(facts["size"], facts["last_modified"].timestamp())
        folders = {name.rpartition("/")[0] for name in files}
        markers = {name for name in folders & files.keys() if files[name].size == 0}
        return {name: files[name] for name in sorted(files.keys() - markers)}

    def exists(self, path: str) -> bool:
        path = stored_path(path, self.uri)
        try:
            self._call("look up", path, lambda obs, connection: obs.head(connection, path))
        except StoredFileMissing:
            return False
        return True

    def delete(self, paths: Iterable[str]) -> None:
        names = [stored_path(path, self.uri) for path in paths]
        try:
            if names:
                self._call(
                    "delete", names[0], lambda obs, connection: obs.delete(connection, names)
                )
        except StoredFileMissing:  # stores other than S3: a missing object hides the others
            for name in names:
                self.delete_once(name)

    def delete_once(self, path: str) -> None:
        """Delete an object without retries: a second request might hit a later object."""
        with contextlib.suppress(StoredFileMissing):
            once = replace(self.retry_settings, retries=0)
            self._call("delete", path, lambda obs, connection: obs.delete(connection, path), once)

    def read_version(self, path: str) -> StoredVersion | None:
        """Return the object's current version; None where there is no object."""

        def read(obs: Any, connection: Any) -> StoredVersion:
            result = obs.get(connection, path)
            modified_s = result.meta["last_modified"].timestamp()
            return StoredVersion(bytes(result.bytes()), _mark(result.meta), modified_s)

        try:
            return self._call("read", path, read)
        except StoredFileMissing:
            return None

    def put_if(
        self, path: str, data: bytes, old_version: StoredVersion | None
    ) -> StoredVersion | None:
        """Put the bytes in place of an old version, or where no object exists.

        Args:
            data: Bytes unlike any earlier ones, so that a request whose answer was lost can be told
                from another process's.
            old_version: Version to replace; None to create the object.

        Returns:
            The current version: ours, or what another process has put; None if it has deleted the
            object.
        """
        mode = "create" if old_version is None else old_version.mark
        for attempts_left in (2, 1, 0):
            is_refused = False
            try:
                put = lambda obs, connection: obs.put(connection, path, data, mode=mode)  # noqa: E731
                return StoredVersion(data, _mark(self._call("write", path, put)))
            except (_OtherVersionError, StoredFileMissing):
                is_refused = True
            except OutputError:  # obstore does not know whether the request arrived
                if attempts_left == 0:
                    raise
            current_version = self.read_version(path)
            if is_refused or (current_version is not None and current_version.data == data):
                return current_version
        raise AssertionError

    def _call(
        self,
        operation: str,
        path: str,
        call: Callable[[Any, Any], _T],
        retry_settings: RetrySettings | None = None,
    ) -> _T:
        """Return the result of a call of obstore, with this process's connection."""
        obs = _load_obstore()
        key = (os.getpid(), retry_settings or self.retry_settings)
        try:
            if key not in self._connections:
                self._connections[key] = _open(obs, self._place, key[1])
            return call(obs, self._connections[key])
        except OutputError:  # concerns a file that the URI names
            raise
        except Exception as error:
            cause = _cause(error)
            base = self.uri.partition("?")[0]
            where = f"{base}/{path}" if path else base
            if isinstance(error, FileNotFoundError) and not _NO_BUCKET.search(cause):
                raise StoredFileMissing(f"{where} is missing") from None
            if type(error).__name__ in ("AlreadyExistsError", "PreconditionError"):
                raise _OtherVersionError from None
            for secret in (self._place.user, self._place.password):
                cause = cause.replace(secret, "***") if secret else cause
            # The cause is left out, because its text may hold credentials.
            raise OutputError(
                f"cannot {operation} {where}: {cause}; {_advice(error, cause, self._place.scheme)}"
            ) from None


class _OtherVersionError(OutputError):
    """Error: the object is no longer the version that was to be replaced."""


def _mark(facts: Mapping[str, Any]) -> dict[str, str]:
    """Return the marks of an object's version."""
    return {name: facts[name] for name in ("e_tag", "version") if facts[name] is not None}


def _open(obs: Any, place: _Place, retry_settings: RetrySettings) -> Any:
    """Return the obstore client (Azure, Google or S3) of a URI, with its credentials, endpoint,
    timeouts and retries."""
    backoff = {"init_backoff": timedelta(seconds=retry_settings.first_wait_s)}
    retry = {"max_retries": retry_settings.retries, "backoff": backoff}
    client_options: dict[str, Any] = {
        "read_timeout": timedelta(seconds=retry_settings.timeout_s),
        "timeout": timedelta(days=1),  # limit of a complete download
    }
    settings: dict[str, Any] = {"client_options": client_options, "retry_config": retry}
    if place.scheme in _AZURE_SCHEMES:
        return obs.store.AzureStore.from_url(place.public, **settings)
    settings["prefix"] = place.folder
    if place.user == _ANONYMOUS:
        settings["skip_signature"] = True
    if place.scheme in _GOOGLE_SCHEMES:
        return obs.store.GCSStore(place.host, **settings)
    if place.user not in ("", _ANONYMOUS):
        settings |= {"access_key_id": place.user, "secret_access_key": place.password}
    options = place.options
    if "region" in options:
        settings["region"] = options["region"]
    if "tls_ca_file_path" in options:
        file = Path(options["tls_ca_file_path"])
        with _reading(file):
            client_options["root_certificate"] = file.read_bytes()
    is_virtual = options.get("force_virtual_addressing", "").lower() in ("true", "1")
    settings["virtual_hosted_style_request"] = is_virtual
    endpoint = os.environ.get("AWS_ENDPOINT_URL_S3") or os.environ.get("AWS_ENDPOINT_URL", "")
    if "endpoint_override" in options:
        scheme, _, host = options["endpoint_override"].rpartition("://")
        bucket = f"{place.host}." if is_virtual else ""
        endpoint = f"{scheme or options.get('scheme', 'https')}://{bucket}{host}"
        settings["aws_endpoint_url_s3"] = endpoint  # overrides the environment's
    client_options["allow_http"] = endpoint.startswith("http://")
    # Not every server knows requests that delete many objects.
    return obs.store.S3Store(place.host, disable_bulk_delete=True, **settings)


_load_lock = threading.Lock()
# No thread loads obstore while the process forks.
_release = _load_lock.release
os.register_at_fork(before=_load_lock.acquire, after_in_parent=_release, after_in_child=_release)
# Number of the process that loaded obstore: this one, or the one that it was forked from.
_loaded_by = 0
_obstore_folder = ""


def _load_obstore() -> Any:
    """Return the module obstore.

    Its threads do not survive a fork (in a child its calls never return), and it cannot start them
    again. So a forked process loads a copy of it under another path.
    """
    global _loaded_by, _obstore_folder
    with _load_lock:
        if _loaded_by == 0:
            _obstore_folder = str(Path(importlib.import_module("obstore").__file__ or "").parent)
        elif _loaded_by != os.getpid():
            temporary = Path(tempfile.gettempdir())
            with raise_output_error(temporary), tempfile.TemporaryDirectory() as folder:
                shutil.copytree(_obstore_folder, f"{folder}/obstore")
                for name in [name for name in sys.modules if name.split(".")[0] == "obstore"]:
                    del sys.modules[name]
                sys.path.insert(0, folder)
                importlib.import_module("obstore")
                sys.path.remove(folder)
        _loaded_by = os.getpid()
    return sys.modules["obstore"]


# ---- Advice on obstore's failures ----------------------------------------------------------------

_NO_BUCKET = re.compile("NoSuchBucket|bucket does not exist|ContainerNotFound")
# Variables of the environment with credentials, by scheme.
_CREDENTIALS = {
    "s3": "AWS_ACCESS_KEY_ID, AWS_SECRET_ACCESS_KEY, AWS_REGION",
    **dict.fromkeys(_GOOGLE_SCHEMES, "GOOGLE_APPLICATION_CREDENTIALS"),
    **dict.fromkeys(_AZURE_SCHEMES, "AZURE_STORAGE_ACCOUNT_NAME, AZURE_STORAGE_ACCOUNT_KEY"),
}
# Further advice, by scheme.
_ENDPOINT = {"s3": ", the region, and the endpoint (endpoint_override or AWS_ENDPOINT_URL)"}
# Advice by a pattern of the error's type and text; the first match counts.
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
    """Return the failure without obstore's debugging output; for an answer in XML, its code."""
    text, _, details = str(error).partition("\n\nDebug source")
    text = re.sub(r"<\?xml.*<Code>(.*?)</Code>.*", r"\1", text, flags=re.DOTALL)
    kind = re.search(r"HttpError \{\s*kind: (\w+)", details)
    return " ".join(text.split()) + (f" ({kind[1]})" if kind else "")


def _advice(error: Exception, cause: str, scheme: str) -> str:
    """Return what to do about a failure."""
    text = f"{type(error).__name__} {cause}"
    advice = next(advice for pattern, advice in _ADVICE.items() if re.search(pattern, text))
    return advice.format(credentials=_CREDENTIALS[scheme], endpoint=_ENDPOINT.get(scheme, ""))
