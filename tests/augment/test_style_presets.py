"""Style presets: files that are as they should be, and moods that are what they say."""

import itertools

import numpy as np
import pytest

from augment.effects.style.statistics import LAND, SKY, WHOLE, closed_maps, statistics_of
from augment.effects.style.style import SHARES, parse_statistics, preset_statistics, together
from augment.errors import StyleError
from recipes.style import style_preset_names, style_preset_text

NAMES = style_preset_names()
GOOD = """
land:
  mean: [0.3, 0.4, 0.5]
  covariance: [[0.02, 0.01, 0.01], [0.01, 0.02, 0.01], [0.01, 0.01, 0.02]]
sky:
  mean: [1, 0, 0.5]
  covariance: [[0, 0, 0], [0, 0, 0], [0, 0, 0]]
"""


def street():
    """The statistics of a street by day with a skewed, bounded spread, as photographs have."""
    rng = np.random.default_rng(0)
    light = rng.beta(2, 4.5, (3000, 1))
    land = np.clip(light * (1, 1.02, 1.04) + 0.02 * rng.standard_normal((3000, 3)), 0, 1)
    height = rng.uniform(0, 1, (1000, 1))
    sky = (0.5, 0.6, 0.75) + height * (0.25, 0.2, 0.1) + 0.01 * rng.standard_normal((1000, 3))
    both = np.concatenate([land, sky])
    found = {WHOLE: statistics_of(both)}
    found |= {LAND: statistics_of(land, total=4000.0), SKY: statistics_of(sky, total=4000.0)}
    return {LAND: land, SKY: sky}, found


def styled(name, **keywords):
    pixels, content = street()
    maps = closed_maps(
        content,
        preset_statistics(name),
        **({"method": "mkl", "strength": 1.0, "per_region": False} | keywords),
    )
    of = {LAND: maps.splats[0].double().numpy(), SKY: maps.sky.double().numpy()}
    return {region: pixels[region] @ m[:, :3].T + m[:, 3] for region, m in of.items()}


def test_the_moods_that_recipes_and_docs_name_are_there():
    assert {"overcast", "snow-light", "dusk", "rain", "golden-hour", "night"} <= set(NAMES)


@pytest.mark.parametrize("name", NAMES)
def test_presets_are_statistics_and_say_where_they_come_from(name):
    found = preset_statistics(name)
    assert set(found) == {WHOLE, LAND, SKY}
    for statistics in found.values():
        assert ((statistics.mean > 0) & (statistics.mean < 1)).all()
        assert np.linalg.eigvalsh(statistics.covariance)[0] > 0
    comment = [line for line in style_preset_text(name).splitlines() if line.startswith("#")]
    assert len(comment) >= 3 and "CC BY 4.0" in " ".join(comment)


@pytest.mark.parametrize("name", NAMES)
def test_presets_cut_off_few_colours_of_a_street_and_keep_roads_nearly_grey(name):
    after = styled(name)
    for region, pixels in after.items():
        cut = np.maximum(np.maximum(-pixels, pixels - 1), 0).max(1)
        assert (cut > 0.02).mean() < 0.06, region
    mean = after[LAND].mean(0)
    assert (mean.max() - mean.min()) < 0.15, "land is tinted, not dyed"


def test_no_two_moods_are_alike():
    for one, other in itertools.combinations(NAMES, 2):
        first, second = preset_statistics(one), preset_statistics(other)
        apart = [np.abs(first[r].mean - second[r].mean).max() for r in (LAND, SKY)]
        assert max(apart) > 0.04, (one, other)


def test_moods_are_what_their_names_say():
    def light(name, region):
        return preset_statistics(name)[region].mean.mean()

    def warmth(name, region=LAND):
        mean = preset_statistics(name)[region].mean
        return mean[0] - mean[2]

    assert light("night", LAND) < light("blue-hour", LAND) < light("rain", LAND)
    assert light("rain", LAND) < light("overcast", LAND) < light("snow-light", LAND)
    assert light("night", SKY) < light("dusk", SKY) < light("overcast", SKY)
    assert warmth("golden-hour") > 0.1 > warmth("hazy-summer") > 0 > warmth("snow-light")
    assert warmth("blue-hour") < -0.08 and warmth("blue-hour", SKY) < -0.2


def test_a_preset_of_what_is_there_already_changes_nothing():
    _, content = street()
    text = "".join(
        f"{region}:\n  mean: {content[region].mean.tolist()}\n"
        f"  covariance: {content[region].covariance.tolist()}\n"
        for region in (LAND, SKY)
    )
    style = parse_statistics(text, source="here")
    maps = closed_maps(content, style, method="mkl", strength=1.0, per_region=False)
    for found in (maps.splats[0], maps.sky, maps.picture):
        assert found.numpy() == pytest.approx(np.eye(3, 4), abs=1e-5)


def test_the_whole_is_put_together_from_shares():
    rng = np.random.default_rng(1)
    land, sky = rng.random((750, 3)), 0.5 + 0.1 * rng.random((250, 3))
    assert SHARES == {LAND: 0.75, SKY: 0.25}
    parts = (statistics_of(land, total=1000.0), statistics_of(sky, total=1000.0))
    found, expected = together(parts), statistics_of(np.concatenate([land, sky]))
    assert found.mean == pytest.approx(expected.mean) and found.share == 1
    assert found.covariance == pytest.approx(expected.covariance)


def test_good_numbers_are_read_as_they_are():
    found = parse_statistics(GOOD, source="good")
    assert found[SKY].mean.tolist() == [1, 0, 0.5] and not found[SKY].covariance.any()
    assert found[LAND].covariance[0].tolist() == [0.02, 0.01, 0.01]


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("0.3, 0.4, 0.5", "0.3, 0.4", "land.mean: expected 3 finite numbers"),
        ("0.3, 0.4, 0.5", "0.3, 0.4, .nan", "land.mean: expected 3 finite"),
        ("0.3, 0.4, 0.5", "0.3, 0.4, a", "land.mean: expected 3 finite"),
        ("0.3, 0.4, 0.5", "0.3, 0.4, 1.5", "land.mean: must be in"),
        ("[0.3, 0.4, 0.5]", "true", "land.mean: expected 3 finite"),
        ("[0.02, 0.01, 0.01]", "[0.02, 0.01]", "land.covariance: expected 3 x 3"),
        ("[0.02, 0.01, 0.01]", "[0.02, 0.03, 0.01]", "land.covariance: must be symmetric"),
        ("[[0, 0, 0]", "[[-0.1, 0, 0]", "sky.covariance: must have no variance below zero"),
        ("[[0, 0, 0]", "[[.inf, 0, 0]", "sky.covariance: expected 3 x 3 finite"),
        ("mean: [1", "means: [1", "sky: expected the keys mean, covariance; got"),
        ("sky:", "sea:", "expected the keys land, sky; got .*sea"),
        ("sky:", "land: {}\nsky", "not valid YAML"),
        ("sky:", "extra: 1\nsky:", "expected the keys land, sky; got .*extra"),
    ],
)
def test_wrong_files_say_where(old, new, words):
    assert old in GOOD
    with pytest.raises(StyleError, match=f"^here(:7)?: .*({words})"):
        parse_statistics(GOOD.replace(old, new, 1), source="here")


def test_unknown_names_list_the_styles():
    with pytest.raises(StyleError, match=r"did you mean dusk.*overcast"):
        preset_statistics("dsk")


@pytest.mark.parametrize("text", ["", "3", "[1, 2]", "{"])
def test_what_is_no_mapping_is_refused(text):
    with pytest.raises(StyleError, match=r"^here(:1)?: "):
        parse_statistics(text, source="here")
