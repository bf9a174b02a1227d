# SPDX-License-Identifier: Apache-2.0
"""The benchmark's scores: no run writes over another engine's."""

import json
from pathlib import Path

import pytest


@pytest.fixture
def suites(monkeypatch):
    monkeypatch.syspath_prepend(str(Path(__file__).parents[1] / "benchmarks"))
    import score_suites

    return score_suites


def test_each_engine_has_a_folder_of_its_own(suites, tmp_path, monkeypatch, capsys):
    def run_row(title, cases, config, jobs, out):
        assert len(cases) > 3
        return dict.fromkeys(suites.HEAD, 1.0) | {"suite": f"{title} by {config.fit.engine}", "out": str(out)}

    monkeypatch.setattr(suites, "run_row", run_row)
    monkeypatch.setattr(suites.offline, "prepare", lambda say: None)
    for options in ([], ["--engine", "paper"], ["--temporal"]):
        suites.main(["public", *options, "--out", str(tmp_path)])
    for name, engine in (("robust", "robust"), ("paper", "paper"), ("robust_temporal", "robust")):
        (row,) = json.loads((tmp_path / name / "scores.json").read_text())
        assert (row["suite"], row["out"]) == (f"public by {engine}", str(tmp_path / name / "public"))
    assert "engine robust, temporal" in capsys.readouterr().out
    with pytest.raises(SystemExit):
        suites.main(["nothing", "--out", str(tmp_path)])
    assert "expected suites such as public, got nothing" in capsys.readouterr().err
