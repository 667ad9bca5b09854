"""Where a remote store is, what is secret about it, and the file system that opens it."""

from __future__ import annotations

import re
import urllib.parse
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from augment.batch.layout import relative_parts
from augment.errors import OutputError

if TYPE_CHECKING:
    from pyarrow.fs import FileSystem

# An object of these appears once its upload is complete; elsewhere a file grows under its name.
_OBJECT_STORES = ("s3", "gs", "gcs")
_KINDS = (*_OBJECT_STORES, "abfs", "abfss", "hdfs", "viewfs")
_S3_OPTIONS = (
    "endpoint_override",
    "scheme",
    "region",
    "force_virtual_addressing",
    "tls_ca_file_path",
)
_SECRET_OPTION = re.compile(r"key|secret|token|password|credential|signature|^sig$", re.IGNORECASE)
_CONTROL = re.compile(r"[\x00-\x1f\x7f]")
_CONNECT_TIMEOUT_S = 10


@dataclass(frozen=True)
class RemoteUri:
    """A URI in parts; `public` is the same without its secrets, which repr leaves out."""

    public: str
    scheme: str
    _uri: str = field(repr=False)
    _secrets: tuple[str, ...] = field(repr=False)

    @classmethod
    def parse(cls, uri: str) -> RemoteUri:
        """Take a URI apart.

        Raises:
            OutputError: its kind or options are unknown, or its folder climbs with `..`.
        """
        try:
            parsed = urllib.parse.urlsplit(uri)
            query = urllib.parse.parse_qsl(parsed.query, strict_parsing=bool(parsed.query))
        except ValueError as error:
            raise OutputError(f"{uri.partition(':')[0]}://... is no URI: {error}") from None
        user, _, host = parsed.netloc.rpartition("@")
        if parsed.scheme in ("abfs", "abfss") or user == "anonymous":  # a container, nobody
            user, host = "", parsed.netloc
        shown = [(name, value) for name, value in query if not _SECRET_OPTION.search(name)]
        hidden = [value for name, value in query if _SECRET_OPTION.search(name)]
        path, options = parsed.path.rstrip("/"), urllib.parse.urlencode(shown)
        public = urllib.parse.urlunsplit((parsed.scheme, host, path, options, ""))
        _check_kind(parsed.scheme, host, public)
        _check_folder(path, parsed.fragment, public)
        if parsed.scheme == "s3":
            _check_s3_options([name for name, _ in query], public)
        secrets = {*user.split(":"), *map(urllib.parse.unquote, user.split(":")), *hidden}
        return cls(public, parsed.scheme, uri, tuple(sorted(secrets - {""}, key=len, reverse=True)))

    @property
    def writes_whole(self) -> bool:
        """Whether a file appears under its name only when it is complete."""
        return self.scheme in _OBJECT_STORES

    def without_secrets(self, text: str) -> str:
        """The text with user names, passwords and keys of this URI blotted out."""
        for secret in self._secrets:
            text = text.replace(secret, "***")
        return text

    def open(self, timeout_s: float) -> FileSystem:
        """A new file system whose root is the URI's folder; it does not try again by itself.

        Raises:
            OSError: there is no such bucket, no answer ...; others of pyarrow.
        """
        from pyarrow.fs import FileSystem, FileType, SubTreeFileSystem

        if self.scheme == "s3":
            system, root = self._open_s3(timeout_s)
        else:
            system, root = FileSystem.from_uri(self._with_limits(timeout_s))
        bucket = root.split("/")[0]
        if self.writes_whole and system.get_file_info(bucket).type == FileType.NotFound:
            raise OSError(f"there is no bucket {bucket!r}")
        return SubTreeFileSystem(root, system)

    def _with_limits(self, timeout_s: float) -> str:
        """Google's library would try for a quarter of an hour."""
        if self.scheme not in ("gs", "gcs") or "retry_limit_seconds=" in self._uri:
            return self._uri
        mark = "&" if "?" in self._uri else "?"
        return f"{self._uri}{mark}retry_limit_seconds={timeout_s:g}"

    def _open_s3(self, timeout_s: float) -> tuple[FileSystem, str]:
        from pyarrow.fs import AwsStandardS3RetryStrategy, S3FileSystem

        parsed = urllib.parse.urlsplit(self._uri)
        options: dict[str, Any] = dict(urllib.parse.parse_qsl(parsed.query))
        virtual = options.pop("force_virtual_addressing", "false").lower() in ("true", "1")
        user, _, bucket = parsed.netloc.rpartition("@")
        if user:
            name, _, password = user.partition(":")
            options["access_key"] = urllib.parse.unquote(name)
            options["secret_key"] = urllib.parse.unquote(password)
        system = S3FileSystem(
            **options,
            force_virtual_addressing=virtual,
            request_timeout=timeout_s,
            connect_timeout=min(timeout_s, _CONNECT_TIMEOUT_S),
            retry_strategy=AwsStandardS3RetryStrategy(max_attempts=1),
            # A small object takes one request instead of three.
            allow_delayed_open=True,
            # Without it, closing after a part has failed completes an upload that lacks the part.
            background_writes=True,
        )
        return system, (bucket + urllib.parse.unquote(parsed.path)).rstrip("/")


def _check_kind(scheme: str, host: str, public: str) -> None:
    if scheme not in _KINDS and not scheme.startswith("fsspec+"):
        raise OutputError(
            f"{public}: there are no stores of the kind {scheme!r}; use a path of this machine, "
            f"or one of {', '.join(_KINDS)}"
        )
    if scheme in _OBJECT_STORES and not host:
        raise OutputError(f"{public} names no bucket; expected {scheme}://bucket/folder")


def _check_folder(path: str, fragment: str, public: str) -> None:
    folder = urllib.parse.unquote(path).removeprefix("/")
    is_clean = "/".join(relative_parts(folder) or ()) == folder and not _CONTROL.search(folder)
    if fragment or not is_clean:
        raise OutputError(
            f"{public}: the folder must be named without '.', '..', '#', backslashes and double "
            f"slashes; write a sign that has a meaning in URIs as %23 and so on"
        )


def _check_s3_options(names: list[str], public: str) -> None:
    for name in names:
        if name not in _S3_OPTIONS:
            raise OutputError(
                f"{public}: S3 has no option {name!r} here; the options are "
                f"{', '.join(_S3_OPTIONS)}. Credentials come from the environment "
                f"(AWS_ACCESS_KEY_ID, AWS_SECRET_ACCESS_KEY) or ~/.aws"
            )
