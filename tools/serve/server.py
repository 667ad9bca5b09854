"""`climategs serve`: opens scenes, serves them until it is interrupted, and stops cleanly."""

from __future__ import annotations

import importlib
import signal
import tempfile
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from augment.errors import ClimateGSError
from augment.render.backends import renders_on_gpu
from recipes.schema import Recipe
from tools.output import compiling_noted, print_note, write_json
from tools.render import resolve_recipes
from tools.view.access import is_loopback
from tools.warm_up import kernel_modules, warm_up

if TYPE_CHECKING:
    from tools.cli import ServeOptions
    from tools.serve.metrics import Metrics
    from tools.serve.scene_store import SceneStore

# Threads for requests that take no time, beside those for images and sweeps.
_NUM_SHORT_REQUESTS = 8
# Time that requests in flight get after the first signal to stop, seconds.
_GRACE_S = 30.0


def serve_scenes(options: ServeOptions) -> int:
    """Serve scenes until the user interrupts. Return the exit code."""
    _check_grpc()
    from tools.serve.metrics import metrics_text

    recipes = served_recipes(options.recipe, options.variants, options.overrides)
    of_street = any("procedural:" in uri for uri in options.scenes)
    on_gpu = renders_on_gpu(options.backend)
    modules = [] if on_gpu else kernel_modules(recipes, options.backend, of_street=of_street)
    with compiling_noted(modules, on_gpu=on_gpu):
        warm_up(recipes, options.backend)
    with start_service(options, recipes) as running:
        stop = threading.Event()
        names = (signal.SIGINT, signal.SIGTERM)
        handlers = {name: signal.signal(name, lambda *_: stop.set()) for name in names}
        try:
            print(_ready_text(options, running), flush=True)
            stop.wait()
        finally:
            for name, handler in handlers.items():
                signal.signal(name, handler)
        print_note("stopping: requests in flight are finished; interrupt again to give them up")
        running.stop(_GRACE_S)
    facts = running.metrics.facts()
    write_json(options.metrics, facts)
    print_note(metrics_text(facts))
    return 0


def served_recipes(
    names: tuple[str, ...], variants: int | None, overrides: tuple[str, ...]
) -> list[Recipe]:
    """Return the recipes that clients can choose, in numbers.

    Raises:
        RecipeError: a recipe is invalid.
        ClimateGSError: one stands on recorded images, which have no other poses.
    """
    recipes = resolve_recipes(names or ("clear",), variants, 1.0, overrides)
    for recipe in recipes:
        if recipe.render.is_on_recorded:
            raise ClimateGSError(
                f"recipe {recipe.name}: render.base is 'recorded', and a simulator asks for poses "
                f"that no camera recorded; serve it with --set render.base=splats"
            )
        if any(sign in recipe.name for sign in "@#"):
            raise ClimateGSError(
                f"recipe {recipe.name!r} cannot be asked for by clients, since @ and # separate a "
                f"scene, its recipe and the variant; give it another name"
            )
    return recipes


@dataclass(frozen=True, eq=False)
class RunningService:
    """A server that takes requests."""

    port: int
    """Port that it listens at."""
    store: SceneStore
    """Its scenes."""
    metrics: Metrics
    """Figures of its requests."""
    stop: Callable[[float], None]
    """Function that takes no further request, and waits for those in flight so many seconds."""


@contextmanager
def start_service(options: ServeOptions, recipes: list[Recipe]) -> Iterator[RunningService]:
    """Open the scenes and serve them while the block runs.

    Args:
        options: the options of the command.
        recipes: the recipes that clients can choose, the default first.

    Raises:
        ClimateGSError: a scene cannot be opened, a TLS file cannot be read, or the address cannot
            be listened at.
    """
    _check_grpc()
    import grpc
    from grpc_health.v1 import health, health_pb2, health_pb2_grpc
    from grpc_reflection.v1alpha import reflection

    from tools.serve.drawing import DrawingThreads
    from tools.serve.messages import MAX_MESSAGE_BYTES, service_names
    from tools.serve.metrics import Metrics
    from tools.serve.scene_store import SceneStore, parse_source
    from tools.serve.service import Limits, SensorService

    credentials = _credentials(options)
    threads = DrawingThreads()
    metrics = Metrics()
    num_requests = options.max_requests + _NUM_SHORT_REQUESTS
    with tempfile.TemporaryDirectory(prefix="climategs-serve-") as folder:
        store = SceneStore(
            [parse_source(text) for text in options.scenes],
            recipes,
            backend=options.backend,
            max_open=options.max_scenes,
            folder=Path(folder),
            on_open=lambda opened: threads.fit_to(opened.scene, opened.backend),
        )
        server = grpc.server(
            ThreadPoolExecutor(num_requests, thread_name_prefix="request"),
            maximum_concurrent_rpcs=num_requests,
            options=[
                ("grpc.max_receive_message_length", MAX_MESSAGE_BYTES),
                ("grpc.max_send_message_length", MAX_MESSAGE_BYTES),
                ("grpc.so_reuseport", 0),
            ],
        )
        limits = Limits(options.max_pixels, options.max_requests)
        log = print_note if options.log else None
        service = SensorService(store, threads, limits, metrics, log)
        server.add_generic_rpc_handlers(service.handlers())
        health_servicer = health.HealthServicer()
        health_pb2_grpc.add_HealthServicer_to_server(health_servicer, server)
        all_names = (*service_names(), health.SERVICE_NAME, reflection.SERVICE_NAME)
        reflection.enable_server_reflection(all_names, server, pool=_reflected_pool())
        port = _listen(server, options.host, options.port, credentials)
        server.start()
        for name in ("", *service_names()):
            health_servicer.set(name, health_pb2.HealthCheckResponse.SERVING)

        def stop(grace_s: float) -> None:
            health_servicer.enter_graceful_shutdown()
            server.stop(grace_s).wait()

        try:
            yield RunningService(port, store, metrics, stop)
        finally:
            stop(0)
            threads.close()


def _check_grpc() -> None:
    """Raise ClimateGSError where the packages of the extra are not installed."""
    try:
        for name in ("grpc", "grpc_health.v1", "grpc_reflection.v1alpha"):
            importlib.import_module(name)
    except ModuleNotFoundError as error:
        raise ClimateGSError(
            f"climategs serve needs grpcio, which is not installed ({error}): "
            f"pip install 'climategs[serve]'"
        ) from error


def _reflected_pool() -> Any:
    """Return the pool of all services, which clients can ask for."""
    from grpc_health.v1 import health_pb2
    from grpc_reflection.v1alpha import reflection_pb2

    from tools.serve.messages import descriptor_pool

    pool = descriptor_pool()
    for module in (health_pb2, reflection_pb2):
        pool.AddSerializedFile(module.DESCRIPTOR.serialized_pb)
    return pool


def _listen(server: Any, host: str, port: int, credentials: Any) -> int:
    """Have a server listen at an address. Return the port."""
    name = f"[{host}]" if ":" in host else host
    address = f"{name}:{port}"
    try:
        if credentials is None:
            return server.add_insecure_port(address)
        return server.add_secure_port(address, credentials)
    except RuntimeError as error:
        raise ClimateGSError(
            f"cannot listen at {address}: it is in use, or no address of this machine; choose "
            f"another --port (0 takes a free one) or --host"
        ) from error


def _credentials(options: ServeOptions) -> Any:
    """Return the credentials of the server; None without TLS."""
    if options.tls_cert is None:
        return None
    import grpc

    assert options.tls_key is not None
    key = _read(options.tls_key, "--tls-key")
    certificate = _read(options.tls_cert, "--tls-cert")
    client_ca = None
    if options.tls_client_ca is not None:
        client_ca = _read(options.tls_client_ca, "--tls-client-ca")
    return grpc.ssl_server_credentials(
        [(key, certificate)], root_certificates=client_ca, require_client_auth=client_ca is not None
    )


def _read(path: Path, option: str) -> bytes:
    """Return the bytes of a PEM file."""
    try:
        data = path.read_bytes()
    except OSError as error:
        raise ClimateGSError(f"{option} {path} cannot be read: {error.strerror}") from error
    if b"-----BEGIN " not in data:
        raise ClimateGSError(f"{option} {path} is not a PEM file (-----BEGIN ...)")
    return data


def _ready_text(options: ServeOptions, running: RunningService) -> str:
    """Return the line that says where the server listens. A note warns of open addresses."""
    if not is_loopback(options.host):
        secured = options.tls_client_ca is not None
        encrypted = "" if options.tls_cert else " Nothing is encrypted (see --tls-cert)."
        audience = "clients with a certificate of that authority" if secured else "all who reach it"
        print_note(
            f"note: {options.host} is not for this machine alone: {audience} can have images of "
            f"these scenes rendered.{encrypted}"
        )
    scenes = running.store.scene_names
    count = len(running.store.scene_ids)
    return (
        f"serving {', '.join(scenes)} under {count} names at {options.host}:{running.port}   "
        f"(Ctrl-C ends it)"
    )
