"""To which configurations a checkpoint belongs."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any, cast

from monitor.config import Configuration
from monitor.service.restart import Checkpointer

FRAME = Path(__file__).parents[2] / "recordings" / "frame.toml"


def key(text: str, out: Path) -> str:
    config = Configuration.model_validate(tomllib.loads(text))
    return Checkpointer(out, config, None, cast(Any, None), cast(Any, None)).key


def test_a_label_of_a_sensor_belongs_to_the_same_checkpoint_and_another_channel_does_not(tmp_path: Path) -> None:
    text = FRAME.read_text(encoding="utf-8")
    labelled = text.replace('channel = "a1"', 'channel = "a1"\nlabel = "roof"')
    assert labelled != text and key(labelled, tmp_path) == key(text, tmp_path)
    assert key(text.replace("three-story frame", "another name"), tmp_path) == key(text, tmp_path)
    assert key(text.replace('channel = "a1"', 'channel = "x1"'), tmp_path) != key(text, tmp_path)
