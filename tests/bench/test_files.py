"""A run's file is whole, is read back as it was, and is refused by name when it is not ours."""

import json
import math

import pytest

from jaxctrl.bench import _files

HEAD = '{"schema": 1, "suites": [], "rows": ['


def test_a_run_is_read_back_as_it_was_saved(tmp_path):
    run = _files.header(["peers"], quick=True)
    timing = {"ms": 1.0, "cpu_ms": 1.0, "relative": [[0.5, 0.25]]}
    run["rows"] = [{"suite": "peers", "cost": math.nan, "timing": timing}]
    _files.save(tmp_path / "run.json", run)
    found = _files.load(tmp_path / "run.json")
    assert found["rows"] == [{"suite": "peers", "cost": None, "timing": timing}]
    assert found["machine"]["cores"] >= 1 and found["versions"]["jax"]
    assert found["complete"] is False
    assert [path.name for path in tmp_path.iterdir()] == ["run.json"]


def test_no_file_holds_a_bare_nan(tmp_path):
    run = _files.header([], quick=True) | {"rows": [{"a": [math.nan, -math.inf], "b": (1.5,)}]}
    _files.save(tmp_path / "run.json", run)
    text = (tmp_path / "run.json").read_text()
    assert "NaN" not in text and "Infinity" not in text
    assert json.loads(text)["rows"] == [{"a": [None, None], "b": [1.5]}]


def test_a_failed_save_leaves_the_old_file_and_nothing_else(tmp_path):
    path = tmp_path / "run.json"
    _files.save(path, _files.header([], quick=True))
    before = path.read_text()
    with pytest.raises(TypeError):
        _files.save(path, {"rows": object()})
    assert path.read_text() == before
    assert [each.name for each in tmp_path.iterdir()] == ["run.json"]


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        (None, "cannot be read"),
        (HEAD + '{"timing": {"ms": 1, "cpu_ms": 1, "relative": [[0]]}}]}', "row 0"),
        ("{", "is not JSON"),
        ("[1]", "is not a file of"),
        ('{"schema": 1, "suites": [], "rows": [NaN]}', "NaN"),
        ('{"schema": 99, "suites": [], "rows": []}', "layout 99"),
        ('{"schema": 1, "suites": [], "rows": [3]}', "row 0"),
        ('{"schema": 1, "suites": [], "rows": [{"timing": {"ms": "long"}}]}', "row 0"),
        ('{"schema": 1, "suites": [], "rows": [{"timing": {"ms": 1, "relative": []}}]}', "row"),
    ],
)
def test_an_unusable_file_is_refused_with_its_name_and_the_reason(tmp_path, text, reason):
    path = tmp_path / "old.json"
    if text is not None:
        path.write_text(text)
    with pytest.raises(_files.FileError, match=reason) as refused:
        _files.load(path)
    assert str(path) in str(refused.value)


def test_a_file_that_cannot_be_written_is_refused(tmp_path):
    for path in (tmp_path, tmp_path / "nowhere" / "run.json"):
        with pytest.raises(_files.FileError, match=str(path)):
            _files.check_writable(path)
