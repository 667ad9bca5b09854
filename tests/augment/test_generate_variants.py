"""A variant of an output is made from one thing only."""

from __future__ import annotations

import dataclasses

import pytest

from augment.errors import OutputError
from augment.jobs.block_worker import VARIANTS, enter_variant
from augment.jobs.manifest import Identity
from augment.jobs.store import open_store

FOG = Identity("fake:street", "0123456789abcdef", "recorded", "0.1.0", "auto")


def test_the_same_may_come_again_and_another_may_not(tmp_path):
    store = open_store(tmp_path)
    enter_variant(store, "street/north", "fog-000", FOG)
    enter_variant(store, "street/north", "fog-000", FOG)
    enter_variant(store, "street/north", "fog-001", dataclasses.replace(FOG, recipe_hash="other"))
    with pytest.raises(OutputError, match=r"fog-000 already holds .* recipe hash there '0123"):
        changed = dataclasses.replace(FOG, recipe_hash="fedcba9876543210")
        enter_variant(store, "street/north", "fog-000", changed)
    assert len(store.list(VARIANTS)) == 2


@pytest.mark.parametrize("text", [b"", b"[]", b'{"source": 1}', b"{"])
def test_a_damaged_record_is_named(tmp_path, text):
    store = open_store(tmp_path)
    store.write(f"{VARIANTS}/street/fog-000.json", text)
    with pytest.raises(OutputError, match=r"street/fog-000\.json is damaged"):
        enter_variant(store, "street", "fog-000", FOG)
