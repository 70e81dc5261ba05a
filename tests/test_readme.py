"""The programs of the README run as printed, but for fewer trials and restarts."""

import re
from pathlib import Path

ROOT = Path(__file__).parents[1]


def test_programs_of_the_readme_run(tmp_path, monkeypatch, capsys):
    text = (ROOT / "README.md").read_text()
    programs = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    assert len(programs) == 4
    monkeypatch.chdir(tmp_path)
    names = {}
    for program in programs:
        exec(program.replace("1000)", "20)").replace("(100, 100, 1)", "(3, 100, 1)"), names)
    assert (tmp_path / "reach.pdf").stat().st_size > 1000
    assert bool(names["solution"].status.ok) and bool(names["best"].status.ok)
    assert names["best"].us.shape == (100, 1)
    assert names["comparison"].ok and (tmp_path / "theories.pdf").stat().st_size > 1000
    assert names["timing"].ok
    assert "3 problems, 3 converged" in capsys.readouterr().out
