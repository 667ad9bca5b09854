"""The messages and methods of the sensor service, made from its compiled descriptor set.

`protos/sensorsim.binpb` is the output of `protoc --include_imports --descriptor_set_out` for the
.proto files beside it. Classes are made when they are first asked for, so that no generated code is
bound to a version of protobuf.

The service has two names: `nre.grpc.protos.sensorsim` (AlpaSim, NuRec up to 26.09) and `sensorsim`
(NuRec 26.10). Both are in the pool. Their messages are the same on the wire, so that the server
uses the classes of the first.
"""

from __future__ import annotations

import threading
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

from google.protobuf import descriptor_pb2, message_factory
from google.protobuf.descriptor_pool import DescriptorPool

# Folder of the .proto files and of their compiled descriptors.
PROTO_FOLDER = Path(__file__).parent / "protos"
# Descriptors of both files, compiled.
DESCRIPTOR_FILE = PROTO_FOLDER / "sensorsim.binpb"
# The package that the file itself names.
FIRST_PACKAGE = "nre.grpc.protos.sensorsim"
# Packages under which the service is offered.
PACKAGES = (FIRST_PACKAGE, "sensorsim")
# Name of the service in each package.
SERVICE = "SensorsimService"
# Version of AlpaSim's interface whose fields the messages have: major, minor, patch.
INTERFACE_VERSION = (0, 54, 0)
# Bytes of a message, at most, as of AlpaSim's client.
MAX_MESSAGE_BYTES = 64 << 20
# Held while the pool is built, which several threads may be the first to ask for.
_building = threading.Lock()


class Method(NamedTuple):
    """A method of the service."""

    name: str
    """Name, as in the path of a call."""
    request_class: Any
    """Class of its request."""
    response_class: Any
    """Class of its response."""


def descriptor_pool() -> DescriptorPool:
    """Return the pool with the files of both packages.

    There is one pool: messages of two pools are of different classes.
    """
    with _building:
        return _build_pool()


@cache
def _build_pool() -> DescriptorPool:
    """Return a new pool with the files of both packages."""
    files = descriptor_pb2.FileDescriptorSet.FromString(DESCRIPTOR_FILE.read_bytes())
    pool = DescriptorPool()
    for file in files.file:
        pool.AddSerializedFile(file.SerializeToString())
        if file.package == FIRST_PACKAGE:
            for package in PACKAGES[1:]:
                pool.AddSerializedFile(_renamed(file, package).SerializeToString())
    return pool


def _renamed(
    file: descriptor_pb2.FileDescriptorProto, package: str
) -> descriptor_pb2.FileDescriptorProto:
    """Return a file with the same messages and service in another package."""
    renamed = descriptor_pb2.FileDescriptorProto()
    renamed.CopyFrom(file)
    renamed.name = f"{package}/{file.name}"
    renamed.package = package
    old_prefix = f".{file.package}."
    new_prefix = f".{package}."

    def rename_fields(message: descriptor_pb2.DescriptorProto) -> None:
        for field in message.field:
            if field.type_name:  # setting it, even to nothing, would name a type
                field.type_name = field.type_name.replace(old_prefix, new_prefix, 1)
        for nested in message.nested_type:
            rename_fields(nested)

    for message in renamed.message_type:
        rename_fields(message)
    for service in renamed.service:
        for method in service.method:
            method.input_type = method.input_type.replace(old_prefix, new_prefix, 1)
            method.output_type = method.output_type.replace(old_prefix, new_prefix, 1)
    return renamed


@cache
def message_class(name: str) -> Any:
    """Return the class of a message, such as `RGBRenderRequest` or `common.Pose`."""
    full_name = name if name.startswith("common.") else f"{FIRST_PACKAGE}.{name}"
    return message_factory.GetMessageClass(descriptor_pool().FindMessageTypeByName(full_name))


@cache
def enum_numbers(name: str) -> dict[str, int]:
    """Return the numbers of an enum by their names, such as those of `ImageFormat`."""
    enum = descriptor_pool().FindEnumTypeByName(f"{FIRST_PACKAGE}.{name}")
    return {value.name: value.number for value in enum.values}


def service_names() -> tuple[str, ...]:
    """Return the full names of the service, one in each package."""
    return tuple(f"{package}.{SERVICE}" for package in PACKAGES)


@cache
def methods() -> tuple[Method, ...]:
    """Return the methods of the service, in the order of the .proto file."""
    service = descriptor_pool().FindServiceByName(f"{FIRST_PACKAGE}.{SERVICE}")
    return tuple(
        Method(
            method.name,
            message_factory.GetMessageClass(method.input_type),
            message_factory.GetMessageClass(method.output_type),
        )
        for method in service.methods
    )


class Stub:
    """Calls of the service by the methods' names, over a channel: `Stub(channel).render_rgb(...)`.

    Args:
        channel: a channel of grpc.
        package: the package whose service is called.
    """

    def __init__(self, channel: Any, package: str = FIRST_PACKAGE) -> None:
        for method in methods():
            call = channel.unary_unary(
                f"/{package}.{SERVICE}/{method.name}",
                request_serializer=method.request_class.SerializeToString,
                response_deserializer=method.response_class.FromString,
            )
            setattr(self, method.name, call)
