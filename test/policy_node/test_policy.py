"""Policies of any kind on disk: the table of kinds, cards, and folders that appear whole."""

from __future__ import annotations

import importlib
import json

import pytest
from mlps import mlp
from toy_policies import ChunkedPolicy, ImagePolicy

from curation_ros.core.errors import PolicyError
from policy_node import policy as module
from policy_node.policy import CARD, FORMAT, POLICIES, load_policy, read_card, write_policy


@pytest.fixture
def _toy_kinds(monkeypatch):
    """Two more kinds: a line in the table each."""
    more = {
        "toy-chunked": "toy_policies:ChunkedPolicy",
        "toy-image": "toy_policies:ImagePolicy",
    }
    monkeypatch.setattr(module, "POLICIES", {**POLICIES, **more})


@pytest.mark.parametrize("kind", POLICIES)
def test_every_kind_in_the_table_is_a_class_with_the_members_of_a_policy(kind):
    name, _, attribute = POLICIES[kind].partition(":")
    found = getattr(importlib.import_module(name), attribute)
    members = (n for n in vars(module.Policy) if not n.startswith("_") and n != "card")
    assert [n for n in members if not hasattr(found, n)] == []


@pytest.mark.usefixtures("_toy_kinds")
@pytest.mark.parametrize("make", [mlp, ChunkedPolicy, ImagePolicy])
def test_policy_is_loaded_by_the_kind_on_its_card(make, tmp_path):
    made = make()
    loaded = load_policy(made.save(tmp_path / "p"))
    assert type(loaded) is type(made)
    assert loaded.card == made.card


@pytest.mark.usefixtures("_toy_kinds")
def test_chunked_policy_keeps_its_own_settings(tmp_path):
    loaded = load_policy(ChunkedPolicy(horizon=9, ensembles=True).save(tmp_path / "p"))
    assert (loaded.horizon, loaded.ensembles) == (9, True)


def test_unknown_kind_is_refused_with_the_known_ones(tmp_path):
    ChunkedPolicy().save(tmp_path / "p")
    with pytest.raises(PolicyError, match=r"card\.json: kind 'toy-chunked' .* none of mlp"):
        load_policy(tmp_path / "p")


def test_kind_that_is_no_text_is_refused(tmp_path):
    write_policy(tmp_path / "p", {"kind": ["mlp"]}, {})
    with pytest.raises(PolicyError, match="kind"):
        load_policy(tmp_path / "p")


def test_card_of_format_1_is_an_mlp(tmp_path):
    (tmp_path / CARD).write_text(json.dumps({"format": 1}))
    assert read_card(tmp_path)["kind"] == "mlp"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("{", "is not JSON"),
        ("[]", "expected a JSON object"),
        ('{"kind": "mlp"}', "'format' is missing"),
        ('{"format": 2}', "'kind' is missing"),
        ('{"format": 9, "kind": "mlp"}', "'format' is 9, expected 2"),
    ],
)
def test_card_that_is_none_is_refused(tmp_path, text, words):
    (tmp_path / CARD).write_text(text)
    with pytest.raises(PolicyError, match=words) as caught:
        read_card(tmp_path)
    assert str(tmp_path / CARD) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_folder_has_the_card_and_the_files(tmp_path):
    folder = write_policy(tmp_path / "a" / "p", {"kind": "x"}, {"weights": b"123"})
    assert json.loads((folder / CARD).read_text()) == {"format": FORMAT, "kind": "x"}
    assert (folder / "weights").read_bytes() == b"123"
    assert [path.name for path in folder.parent.iterdir()] == ["p"]


def test_folder_that_exists_is_left_as_it_is(tmp_path):
    folder = write_policy(tmp_path / "p", {"kind": "x"}, {})
    before = (folder / CARD).read_bytes()
    with pytest.raises(PolicyError, match="exists"):
        write_policy(folder, {"kind": "y"}, {})
    assert (folder / CARD).read_bytes() == before


def test_folder_that_cannot_be_written_leaves_nothing_behind(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(PolicyError, match="file"):
        write_policy(tmp_path / "file" / "p", {"kind": "x"}, {})
    assert [path.name for path in tmp_path.iterdir()] == ["file"]
