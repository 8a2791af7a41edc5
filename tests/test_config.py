"""The configuration is strict: what is not understood is refused in one line that says how to fix it."""

from __future__ import annotations

import json
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import Any, Literal

import pytest

from mvdyn_gtsam.config import (
    Config,
    config_from_dict,
    describe,
    given_settings,
    load_config,
    load_settings,
    to_dict,
)
from mvdyn_gtsam.config_tree import build, flatten, nest, sift, to_plain
from mvdyn_gtsam.errors import ConfigError


class Mode(Enum):
    FAST = "fast"
    EXACT = "exact"


@dataclass(frozen=True)
class Everything:
    flag: bool = False
    count: int = 3
    ratio: float = 0.5
    text: str = "a"
    mode: Mode = Mode.FAST
    maybe: int | None = None
    model: Path | None = None
    pair: tuple[int, float] = (1, 2.0)
    many: tuple[int, ...] = ()
    choice: Literal["a", "b"] = "a"


def test_defaults_round_trip() -> None:
    assert config_from_dict(json.loads(json.dumps(to_dict(Config())))) == Config()


def test_every_key_has_a_source() -> None:
    keys = describe()
    assert {"tracking.window", "graph.temporal_offsets", "frontend.flow.patch_size"} <= {k.key for k in keys}
    missing = [key.key for key in keys if "Source:" not in key.doc]
    assert not missing


def test_file_then_overrides(tmp_path: Path) -> None:
    file = tmp_path / "mine.toml"
    file.write_text("[tracking]\nwindow = 30\nfree = 12\n[graph]\ntemporal_offsets = [1, 3]\n")
    config = load_config(file, ["tracking.free=9", "graph.spatial_overlap = 1"])
    assert (config.tracking.window, config.tracking.free) == (30, 9)
    assert config.graph.temporal_offsets == (1, 3)
    assert config.graph.spatial_overlap == 1.0 and isinstance(config.graph.spatial_overlap, float)


def test_json_file(tmp_path: Path) -> None:
    file = tmp_path / "mine.json"
    file.write_text('{"tracking": {"window": 30}}')
    assert load_config(file).tracking.window == 30


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("tracking.windw=3", r"unknown key tracking\.windw \(did you mean tracking\.window\?\)"),
        ("window=3", r"unknown key window \(did you mean tracking\.window\?\)"),
        ("tracking=3", r"unknown key tracking"),
        ("tracking.window", r"section\.key=value"),
        ("=3", r"section\.key=value"),
        ("tracking.window=many", r"tracking\.window is 'many'; it must be a whole number"),
        ("tracking.window=3.5", r"must be a whole number"),
        ("tracking.window=true", r"must be a whole number"),
        ("tracking.depth_prior_lambda=-1", r"must not be negative"),
        ("tracking.depth_prior_lambda=nan", r"must be finite"),
        ("tracking.free=26", r"between 1 and tracking\.window \(25\)"),
        ("graph.temporal_offsets=[]", r"frame distances"),
        ("graph.temporal_offsets=[1, 'a']", r"temporal_offsets\[1\] is 'a'"),
        ("graph.temporal_offsets=4", r"must be a list"),
        ("graph.spatial_overlap=1.5", r"at most 1"),
        ("capture.truncate=1", r"must be true or false"),
    ],
)
def test_refused_overrides(override: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message) as caught:
        load_config(None, [override])
    assert "--set" in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("[trackin]\nwindow = 3", r"unknown key trackin"),
        ("[tracking]\nwindow = ", r"mine\.toml: "),
        ("tracking = 3", r"tracking is a section"),
        ("[tracking]\nwindow = 1", r"at least 2"),
    ],
)
def test_refused_files(tmp_path: Path, content: str, message: str) -> None:
    file = tmp_path / "mine.toml"
    file.write_text(content)
    with pytest.raises(ConfigError, match=message) as caught:
        load_config(file, ["tracking.window=9"])
    assert "mine.toml" in str(caught.value) and "\n" not in str(caught.value)


def test_missing_file(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"none\.toml: cannot be read \(No such file"):
        load_config(tmp_path / "none.toml")


def test_every_kind_of_value_round_trips() -> None:
    value = Everything(True, 4, 1.5, "b", Mode.EXACT, 7, Path("m.onnx"), (2, 3.0), (1, 2), "b")
    assert build(Everything, json.loads(json.dumps(to_plain(value)))) == value
    assert build(Everything, to_plain(Everything())) == Everything()


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"mode": "slow"}, "one of fast, exact"),
        ({"choice": "c"}, "one of a, b"),
        ({"pair": [1]}, "must hold 2 values"),
        ({"maybe": "x"}, "must be a whole number"),
        ({"text": 3}, "must be a string"),
    ],
)
def test_every_kind_of_value_is_checked(values: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        build(Everything, values)


def test_settings_are_what_is_asked_for_and_nothing_else(tmp_path: Path) -> None:
    file = tmp_path / "mine.toml"
    file.write_text("[tracking]\nwindow = 30\n[graph]\ntemporal_offsets = [1, 3]\n")
    asked: dict[str, Any] = {"tracking": {"window": 25, "free": 9}, "graph": {"temporal_offsets": [1, 3]}}
    overrides = ["tracking.window=25", "tracking.free=9"]
    assert load_settings(file, overrides) == asked
    assert given_settings(asked) == asked
    assert given_settings({"graph": {"temporal_offsets": (1, 3)}}) == {"graph": {"temporal_offsets": [1, 3]}}
    # Of a Config it cannot be told that 25 was asked for.
    del asked["tracking"]["window"]
    assert given_settings(load_config(file, overrides)) == asked
    assert given_settings(None) == given_settings(Config()) == {}
    with pytest.raises(ConfigError, match=r"did you mean tracking\.window"):
        given_settings({"tracking": {"windw": 3}})


def test_settings_that_do_not_stand_alone_are_not_held_against_the_defaults() -> None:
    assert load_settings(None, ["tracking.free=30"], alone=False) == {"tracking": {"free": 30}}
    with pytest.raises(ConfigError, match="--set: tracking.free is 30"):
        load_settings(None, ["tracking.free=30"])
    with pytest.raises(ConfigError, match="--set: tracking.free is 'x'; it must be a whole number"):
        load_settings(None, ["tracking.free=x"], alone=False)


def test_what_is_not_understood_is_sifted_out() -> None:
    values = {"tracking": {"window": 30, "gone": 1, "free": "all"}, "graph": 3, "old": {"a": 1}}
    taken, refused = sift(Config, values)
    assert taken == {"tracking": {"window": 30}}
    assert set(refused) == {"tracking.gone", "tracking.free", "graph", "old"}
    assert sift(Everything, to_plain(Everything()))[1] == {}


def test_flat_and_nested_are_the_same() -> None:
    nested = to_dict(Config())
    assert nest(flatten(nested)) == nested
    assert flatten(nested)["tracking.window"] == 25
