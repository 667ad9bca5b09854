"""The server of the sensor service: TLS, a clean stop, few scenes in memory, addresses."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime, timedelta
from pathlib import Path

import grpc
import pytest
import torch
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import NameOID

from augment.errors import ClimateGSError
from augment.files.scene_file import save_scene_file
from augment.scene.cameras import Camera, Frame
from augment.scene.scene import Scene
from augment.scene.sky import ConstantSky
from tests.scenes import random_gaussians
from tests.tools.serve_requests import EMPTY, image_request, refusal
from tools.cli import ServeOptions
from tools.serve.messages import Stub, message_class
from tools.serve.server import served_recipes, start_service

ROOT = Path(__file__).resolve().parents[2]


def write_scene(path: Path, seed: int = 0) -> Camera:
    """Write a scene of some splats before one camera, which is returned."""
    camera = Camera("front", 64, 48, 40.0, 40.0, 32.0, 24.0, torch.eye(4, dtype=torch.float64))
    frame = Frame(0, 0, torch.eye(4, dtype=torch.float64), {"front": camera})
    gaussians = random_gaussians(200, seed=seed)
    scene = Scene(path.stem, path.stem, gaussians, (), ConstantSky(torch.ones(3)), (frame,))
    save_scene_file(scene, path)
    return camera


def options_for(*scenes: str, **values) -> ServeOptions:
    return ServeOptions(scenes=scenes, recipe=("clear",), port=0, **values)


def start(options: ServeOptions):
    return start_service(options, served_recipes(options.recipe, None, ()))


# ---- Scenes in memory ----------------------------------------------------------------------------


def test_no_more_scenes_are_open_than_allowed_and_all_are_served(tmp_path):
    cameras = {name: write_scene(tmp_path / f"{name}.climategs", s) for s, name in enumerate("abc")}
    paths = [str(tmp_path / f"{name}.climategs") for name in cameras]
    with (
        start(options_for(*paths, max_scenes=2)) as running,
        grpc.insecure_channel(f"127.0.0.1:{running.port}") as channel,
    ):
        stub = Stub(channel)
        store = running.store
        assert list(stub.get_available_scenes(EMPTY).scene_ids)[:3] == ["a", "b", "c"]
        images = {}
        for name in "abcabc":
            data = stub.render_rgb(image_request(name, cameras[name])).image_bytes
            assert images.setdefault(name, data) == data  # a scene that was opened again
            assert store.num_open <= 2
        assert len(set(images.values())) == 3
        # A request keeps its scene open; the next one waits for a place, until it is cancelled.
        with store.borrow("a"), store.borrow("b"):
            code, _ = refusal(
                lambda request, timeout: stub.render_rgb(request, timeout=1.0),
                image_request("c", cameras["c"]),
            )
            assert code == "DEADLINE_EXCEEDED"
        with ThreadPoolExecutor(6) as pool:
            requests = [image_request(name, cameras[name]) for name in "abcabc"]
            answers = list(pool.map(stub.render_rgb, requests))
        assert [answer.image_bytes for answer in answers] == [images[name] for name in "abcabc"]
        assert store.num_open <= 2


def test_one_request_may_have_images_of_more_scenes_than_are_open(tmp_path):
    """Held together, the scenes would wait for each other's place."""
    cameras = {name: write_scene(tmp_path / f"{name}.climategs", s) for s, name in enumerate("ab")}
    paths = [str(tmp_path / f"{name}.climategs") for name in cameras]
    with (
        start(options_for(*paths, max_scenes=1)) as running,
        grpc.insecure_channel(f"127.0.0.1:{running.port}") as channel,
    ):
        stub = Stub(channel)
        requests = [image_request(name, cameras[name]) for name in "abba"]
        items = [{"camera_name": str(n), "request": r} for n, r in enumerate(requests)]
        batch = message_class("BatchRGBRenderRequest")(items=items)
        answers = stub.batch_render_rgb(batch, timeout=60).items
        assert [answer.camera_name for answer in answers] == ["0", "1", "2", "3"]
        images = [answer.result.image_bytes for answer in answers]
        step = message_class("AggregatedRenderRequest")(rgb_requests=requests)
        returns = stub.render_aggregated(step, timeout=60).rgb_returns
        assert [answer.image_bytes for answer in returns] == images
        assert images[0] == images[3] != images[1] == images[2]


def test_scenes_of_one_name_are_refused_unless_one_gets_another(tmp_path):
    write_scene(tmp_path / "a.climategs")
    path = str(tmp_path / "a.climategs")
    with (
        pytest.raises(ClimateGSError, match="two scenes are called 'a'"),
        start(options_for(path, path)),
    ):
        pass
    with start(options_for(path, f"b={path}")) as running:
        assert running.store.scene_names == ("a", "b")


# ---- TLS, addresses ------------------------------------------------------------------------------


def write_certificate(folder: Path, name: str, issuer: Path | None = None) -> Path:
    """Write NAME.pem and NAME.key, signed by another certificate or by itself."""
    key = ec.generate_private_key(ec.SECP256R1())
    subject = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])
    issuer_name = subject
    issuer_key = key
    if issuer is not None:
        issuer_name = x509.load_pem_x509_certificate(issuer.read_bytes()).subject
        key_bytes = issuer.with_suffix(".key").read_bytes()
        issuer_key = serialization.load_pem_private_key(key_bytes, None)
    now = datetime.now(UTC)
    certificate = (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer_name)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - timedelta(days=1))
        .not_valid_after(now + timedelta(days=1))
        .add_extension(x509.SubjectAlternativeName([x509.DNSName("localhost")]), False)
        .add_extension(x509.BasicConstraints(ca=issuer is None, path_length=None), True)
        .sign(issuer_key, hashes.SHA256())
    )
    path = folder / f"{name}.pem"
    path.write_bytes(certificate.public_bytes(serialization.Encoding.PEM))
    path.with_suffix(".key").write_bytes(
        key.private_bytes(
            serialization.Encoding.PEM,
            serialization.PrivateFormat.PKCS8,
            serialization.NoEncryption(),
        )
    )
    return path


def test_tls_serves_clients_of_the_authority_only(tmp_path):
    camera = write_scene(tmp_path / "a.climategs")
    authority = write_certificate(tmp_path, "authority")
    server = write_certificate(tmp_path, "server", authority)
    client = write_certificate(tmp_path, "client", authority)
    stranger = write_certificate(tmp_path, "stranger")
    options = options_for(
        str(tmp_path / "a.climategs"),
        tls_cert=server,
        tls_key=server.with_suffix(".key"),
        tls_client_ca=authority,
    )

    def channel_of(certificate: Path | None):
        pair = (None, None)
        if certificate is not None:
            pair = (certificate.with_suffix(".key").read_bytes(), certificate.read_bytes())
        credentials = grpc.ssl_channel_credentials(authority.read_bytes(), *pair)
        return grpc.secure_channel(f"localhost:{running.port}", credentials)

    with start(options) as running:
        with channel_of(client) as channel:
            assert Stub(channel).render_rgb(image_request("a", camera)).image_bytes
        for certificate in (None, stranger):
            with channel_of(certificate) as channel:
                assert refusal(Stub(channel).get_version, EMPTY)[0] == "UNAVAILABLE"
        with grpc.insecure_channel(f"localhost:{running.port}") as channel:
            assert refusal(Stub(channel).get_version, EMPTY)[0] == "UNAVAILABLE"


def test_files_and_addresses_that_cannot_be_used_are_refused(tmp_path):
    write_scene(tmp_path / "a.climategs")
    path = str(tmp_path / "a.climategs")
    missing = tmp_path / "missing.pem"
    with (
        pytest.raises(ClimateGSError, match=r"--tls-key .* cannot be read"),
        start(options_for(path, tls_cert=missing, tls_key=missing)),
    ):
        pass
    with (
        pytest.raises(ClimateGSError, match="not a PEM file"),
        start(
            options_for(path, tls_cert=tmp_path / "a.climategs", tls_key=tmp_path / "a.climategs")
        ),
    ):
        pass
    with start(options_for(path)) as running:
        busy = options_for(path).model_copy(update={"port": running.port})
        with pytest.raises(ClimateGSError, match="cannot listen at 127"), start(busy):
            pass


# ---- The end -------------------------------------------------------------------------------------


def test_a_stop_finishes_requests_in_flight_and_takes_no_more(tmp_path):
    camera = write_scene(tmp_path / "a.climategs")
    with (
        start(options_for(str(tmp_path / "a.climategs"))) as running,
        grpc.insecure_channel(f"127.0.0.1:{running.port}") as channel,
    ):
        stub = Stub(channel)
        large = image_request("a", camera.scaled(30.0))  # some tenths of a second
        assert stub.render_rgb(image_request("a", camera)).image_bytes  # the channel is open
        begun = stub.render_rgb.future(large)
        deadline_s = time.monotonic() + 30
        while running.metrics.num_in_flight == 0 and time.monotonic() < deadline_s:
            time.sleep(0.001)
        stopping = threading.Thread(target=running.stop, args=(60.0,))
        stopping.start()
        assert begun.result(timeout=60).image_bytes
        stopping.join()
        assert refusal(stub.get_version, EMPTY)[0] == "UNAVAILABLE"


@pytest.mark.long
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_the_command_stops_on_a_signal_and_writes_its_figures(tmp_path, number):
    camera = write_scene(tmp_path / "a.climategs")
    figures = tmp_path / "figures.json"
    words = ["serve", str(tmp_path / "a.climategs"), "--port", "0", "--log"]
    process = subprocess.Popen(
        [sys.executable, "-m", "tools.cli", *words, "--metrics", str(figures)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        cwd=ROOT,
    )
    address = process.stdout.readline().split(" at ")[1].split()[0]
    with grpc.insecure_channel(address) as channel:
        stub = Stub(channel)
        assert stub.render_rgb(image_request("a", camera)).image_bytes
        assert refusal(stub.render_rgb, image_request("b", camera))[0] == "NOT_FOUND"
    process.send_signal(number)
    _, messages = process.communicate(timeout=60)
    assert process.returncode == 0, messages
    assert "render_rgb a 'front' 64x48 OK" in messages
    assert "NOT_FOUND" in messages and "there is no scene 'b'" in messages
    facts = json.loads(figures.read_text())
    assert facts["images"] == 1
    assert facts["methods"]["render_rgb"]["by_status"] == {"NOT_FOUND": 1, "OK": 1}
