"""Output files: JSON of non-finite numbers, and writes that fail."""

import json
import os

import jax.numpy as jnp
import numpy as np
import pytest

from vsr_jax.files.output import plain, replacing, write_json


def test_numbers_that_json_lacks_become_null(tmp_path):
    content = {
        "objective": float("inf"),
        "tip": jnp.array([[1.0, jnp.nan], [0.5, -jnp.inf]]),
        "miss": np.float32("nan"),
        "rows": ({"steps": 3, "name": "nan", "done": np.bool_(True)}, None),
    }
    path = tmp_path / "content.json"
    write_json(path, content)
    assert json.loads(path.read_text()) == {
        "objective": None,
        "tip": [[1.0, None], [0.5, None]],
        "miss": None,
        "rows": [{"steps": 3, "name": "nan", "done": True}, None],
    }
    assert plain(1.5) == 1.5


def test_an_interrupted_write_leaves_the_previous_file_and_no_other(tmp_path):
    path = tmp_path / "file"
    path.write_text("before")

    def fail():
        with replacing(path) as part:
            part.write_text("half")
            raise OSError("disk full")

    with pytest.raises(OSError, match="disk full"):
        fail()
    assert path.read_text() == "before"
    assert os.listdir(tmp_path) == ["file"]
    with replacing(path) as part:
        part.write_text("after")
    assert path.read_text() == "after"
    assert os.listdir(tmp_path) == ["file"]


def test_a_device_is_written_directly():
    with replacing(os.devnull) as part:
        part.write_text("nothing")
    assert os.path.exists(os.devnull)
