"""The page about an output: what it says, what it never does, and what does not stop it."""

from __future__ import annotations

import base64
import hashlib
import tomllib
from collections import Counter
from html.parser import HTMLParser
from pathlib import Path

import pyarrow.parquet as pq
import pytest

from augment.errors import OutputError
from augment.jobs.layout import MANIFEST
from augment.jobs.manifest import publish_part, rows_to_table
from augment.jobs.store import LocalStore
from tests.tools.report_outputs import make_row, street_rows, write_output
from tools import report
from tools.cli import main
from tools.report import write_report
from tools.report_pictures import BUDGET

EVIL = "\"><script>alert(1)</script><img src=x onerror='alert(2)'>\u202e"


class Page(HTMLParser):
    """What a browser would make of the page: tags, attributes, and the text a reader sees."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: Counter[str] = Counter()
        self.attributes: list[tuple[str, str, str | None]] = []
        self.words: list[str] = []
        self.scripts: list[str] = []
        self._inside = ""
        self.feed(text)
        self.text = " ".join(" ".join(self.words).split())

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags[tag] += 1
        self.attributes += [(tag, name, value) for name, value in attrs]
        self._inside = tag

    def handle_endtag(self, tag: str) -> None:
        self._inside = ""

    def handle_data(self, data: str) -> None:
        if self._inside == "script":
            self.scripts.append(data)
        elif self._inside != "style":
            self.words.append(data)

    def values(self, tag: str, attribute: str) -> list[str]:
        return [v or "" for t, a, v in self.attributes if (t, a) == (tag, attribute)]


def page_of(out: Path, images: int = 48) -> Page:
    return Page(write_report(out, images=images).path.read_text(encoding="utf-8"))


@pytest.fixture(scope="module")
def street(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("street")
    failed = make_row("street-0", "fog", 0, 7, "left", status="failed", message="no memory: 12 MB")
    again = failed | {"frame": 8, "message": "no memory: 9 MB"}
    return write_output(out, [*street_rows(), failed, again], lidar=True)


@pytest.fixture(scope="module")
def page(street: Path) -> Page:
    return page_of(street)


def test_the_page_says_what_there_is(page) -> None:
    for words in ("40 images", "2 failed", "2 scenes", "3 recipes", "10 variants", "2 cameras"):
        assert words in page.text
    assert "1.2.3" in page.text and "40×24" in page.text
    assert "Visibility in smog 21.7 to 196 m" in page.text
    assert "3.912 / smog_extinction_per_m" in page.text
    assert "24 images, 6 variants; absent in 16" in page.text
    assert "Snow depth 25 cm in 8 images, 2 variants; absent in 32" in page.text


def test_pictures_of_all_kinds_are_in_it(page) -> None:
    assert page.tags["input"] == 2  # a slider for each scene
    options = page.values("option", "data-name")
    assert options[:3] == ["clear-000", "fog-000", "wet-000"] and len(options) == 2 * 2 * 3
    captions = page.values("img", "alt")
    assert captions.count("Depth") == captions.count("Semantic classes") == 3
    assert any(said.startswith("wet-000, street-") for said in captions)
    assert len(captions) <= 48


def test_labels_and_lidar_are_counted(page) -> None:
    # Every variant's file holds one frame only: the last to be written.
    assert "Car 4 4" in page.text and "Bus 2 2" in page.text
    bars = {said for tag, name, said in page.attributes if (tag, name) == ("span", "aria-label")}
    assert bars == {
        "5–20 % 50 %, 80–95 % 50 %",  # fog: 0.9 and 0.1; the third box is in no pixel
        "0–5 % 50 %, 20–50 % 50 %",  # wet: half under water and half of it under snow; all snow
        "unchanged 40 %, weaker 20 %, scattered in the air or at the water 20 %, code 9 20 %",
    }


def test_failures_are_grouped_by_what_went_wrong(page) -> None:
    assert "2 no memory: 12 MB such as street-0 · fog-000 · frame 7 · left" in page.text


def test_nothing_is_fetched_and_links_stay_in_the_folder(page, street, tmp_path) -> None:
    sources = [v for _, name, v in page.attributes if name in ("src", "srcset", "data")]
    assert sources and all(v and v.startswith("data:image/jpeg;base64,") for v in sources)
    links = page.values("a", "href")
    assert all(link.startswith(("#", "./street-")) for link in links)
    assert all((street / link).is_file() for link in links if link.startswith("./"))
    elsewhere = write_report(street, tmp_path / "page.html").path.read_text(encoding="utf-8")
    assert all(link.startswith("#") for link in Page(elsewhere).values("a", "href"))
    assert str(street.parent) not in elsewhere


def test_only_the_page_s_own_script_may_run(page) -> None:
    (script,) = page.scripts
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    (policy,) = [v for v in page.values("meta", "content") if "default-src" in v]
    assert f"script-src 'sha256-{digest}'" in policy and "default-src 'none'" in policy


def test_the_same_output_gives_the_same_bytes(street) -> None:
    (street / "report.html").unlink(missing_ok=True)
    first = write_report(street).path.read_bytes()
    assert write_report(street).path.read_bytes() == first  # the page itself is not counted


def test_untrusted_names_are_text(tmp_path) -> None:
    rows = street_rows(scenes=1, frames=1)
    write_output(tmp_path, rows)
    wrong = {name: EVIL for name in ("scene", "source", "camera", "surface", "version", "backend")}
    rows = [row | wrong for row in rows]
    for i, row in enumerate(rows):
        row |= {"variant": f"{EVIL}{i}", "recipe": f"{EVIL}{i}", "style": EVIL}
        row |= {f"{EVIL}_m": 0.5 + i}
    rows[0] |= {"image_path": "javascript:alert(3)"}
    rows[1] |= {"status": "failed", "message": EVIL}
    write_output(tmp_path, rows)
    page = page_of(tmp_path)
    assert page.tags["script"] == 1
    assert not [name for _, name, _ in page.attributes if name.startswith("on")]
    assert not [v for v in page.values("a", "href") if not v.startswith(("#", "./"))]
    assert all(v.startswith("data:") for v in page.values("img", "src"))
    assert "<script>alert(1)</script>" in page.text and "\u202e" not in page.text


def test_damaged_files_are_listed_and_do_not_stop_it(tmp_path) -> None:
    rows = street_rows(scenes=1, frames=1)
    write_output(tmp_path, rows)
    missing, cut, changed, _, other = (row["image_path"] for row in rows[:5])
    (tmp_path / missing).unlink()
    (tmp_path / cut).write_bytes((tmp_path / cut).read_bytes()[:60])
    rows[1]["checksum"] = ""
    (tmp_path / changed).write_bytes((tmp_path / other).read_bytes())
    rows[2]["checksum"] = "0" * 64
    (tmp_path / rows[4]["labels_path"]).write_bytes(b"no Parquet")
    (tmp_path / rows[4]["depth_path"]).write_bytes(b"no PNG")
    write_output(tmp_path, rows)
    written = write_report(tmp_path)
    page = Page(written.path.read_text(encoding="utf-8"))
    assert f"{missing} missing" in page.text
    assert f"{cut} " in page.text
    assert f"{changed} its SHA-256 is not the manifest's" in page.text
    assert written.problems >= 3
    assert str(tmp_path.parent) not in page.text
    assert page.tags["img"] > 4


def test_without_a_clear_variant_pairs_are_shown(tmp_path) -> None:
    rows = [row for row in street_rows(scenes=1, frames=1) if row["recipe"] == "fog"]
    write_output(tmp_path, rows)
    page = page_of(tmp_path)
    assert "no variant without weather" in page.text
    assert page.values("option", "data-name")[:3] == ["fog-000", "fog-001", "fog-002"]


def test_few_pictures_or_none(street) -> None:
    for images in (0, 1, 2, 5):
        assert page_of(street, images).tags["img"] <= images


def test_an_output_that_failed_altogether_has_a_page(tmp_path) -> None:
    failed = [make_row(frame=i, status="failed", message="x") for i in range(3)]
    write_output(tmp_path, failed)
    page = page_of(tmp_path)
    assert "3 failed" in page.text and "0 images" in page.text and page.tags["img"] == 0


def test_an_old_manifest_and_one_without_labels(tmp_path) -> None:
    write_output(tmp_path, street_rows(scenes=1, frames=1), buffers=False)
    table = pq.read_table(tmp_path / MANIFEST)
    young = ["box_smog_path", "snow_path", "style", "snow_depth_m", "style_strength", "surface"]
    pq.write_table(table.drop_columns(young), tmp_path / MANIFEST)
    page = page_of(tmp_path)
    assert "10 images" in page.text and "Labels" not in page.text


def test_a_running_job_has_a_page(tmp_path) -> None:
    rows = street_rows(scenes=1, frames=1)
    write_output(tmp_path, rows)
    (tmp_path / MANIFEST).unlink()
    publish_part(LocalStore(tmp_path), "block", rows_to_table(rows[:6]))
    assert "6 images" in page_of(tmp_path).text


def test_of_a_store_elsewhere_the_page_is_written_here(street, tmp_path, monkeypatch) -> None:
    class Elsewhere(LocalStore):
        uri = "s3://bucket/night%20drive?region=x"
        local_dir = None

    monkeypatch.setattr(report, "open_store", lambda _: Elsewhere(street))
    monkeypatch.chdir(tmp_path)
    written = write_report("s3://bucket/night%20drive?region=x")
    assert written.path.name.startswith("night_drive-") and written.path.is_file()
    page = Page(written.path.read_text(encoding="utf-8"))
    assert "night drive" in page.text and page.tags["img"] > 20
    assert all(link.startswith("#") for link in page.values("a", "href"))


def test_an_output_of_any_size_has_a_small_page(tmp_path) -> None:
    def name(i: int) -> str:
        return f"{i:04d}" + '"' * 400

    rows = [
        make_row(name(i), name(i), camera=name(i), status="failed", message=chr(65 + i % 50) * 999)
        for i in range(200)
    ]
    rows += [
        make_row(name(i), name(i), frame=1, camera=name(i), snow_depth_m=0.1 * i)
        for i in range(100)
    ]
    for i, row in enumerate(rows):
        row |= {f"n{k}": float(k * i) for k in range(30)}
    written = write_report(
        write_output(tmp_path, [r | {"image_path": "missing.png"} for r in rows])
    )
    assert written.size + BUDGET * 4 / 3 < report.MAX_PAGE
    page = Page(written.path.read_text(encoding="utf-8"))
    assert "and 160 more scenes with 60 images, 160 failed" in page.text
    assert page.tags["tr"] < 150 and page.tags["svg"] == 24


def test_pictures_give_way_where_a_page_grows_too_large(street, monkeypatch) -> None:
    whole = write_report(street).size
    monkeypatch.setattr(report, "MAX_PAGE", whole - 1)
    smaller = write_report(street)
    assert smaller.size < whole
    assert 12 < Page(smaller.path.read_text(encoding="utf-8")).tags["img"] <= 24


def test_the_command_says_what_it_wrote(street, tmp_path, capsys) -> None:
    assert main(["report", str(street), "--html", str(tmp_path / "a.html"), "--images", "3"]) == 0
    assert f"{tmp_path / 'a.html'} (0." in capsys.readouterr().out
    assert main(["report", str(street), "--images", "401"]) == 2
    assert main(["report", str(tmp_path / "nowhere")]) == 2
    with pytest.raises(OutputError, match="0 to 400 images; got -1"):
        write_report(street, images=-1)


def test_templates_are_installed() -> None:
    root = Path(report.__file__).parent
    patterns = tomllib.loads((root.parent / "pyproject.toml").read_text())["tool"]["setuptools"]
    found = {path for glob in patterns["package-data"]["tools"] for path in root.glob(glob)}
    assert found == {*(root / "templates").iterdir()}
