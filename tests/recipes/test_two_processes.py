"""Two processes on one run folder: one of them has it."""

from dataclasses import replace

import pytest

from recipes import run as run_module
from recipes import runner
from recipes.algorithm import make_algorithm
from recipes.cli import main
from recipes.run import Run
from tests.recipes.test_hostile_checkpoints import RECIPE, STEPS
from tests.recipes.untrained import untrained


def test_of_two_that_begin_at_once_one_gets_the_folder(tmp_path, monkeypatch):
    """The second one finds no run yet, and the first one has begun to make it."""
    folder, refused = tmp_path / "run", list[object]()
    write = run_module.write_text_atomic

    def begin_another(path, text):
        if not refused:
            with pytest.raises(RuntimeError, match="in use by another process") as error:
                Run.create(folder, replace(RECIPE, seed=1))
            refused.append(error)
        write(path, text)

    monkeypatch.setattr(run_module, "write_text_atomic", begin_another)
    Run.create(folder, RECIPE)
    assert refused
    assert Run.open(folder).recipe == RECIPE


def test_the_second_looks_again_once_it_has_the_folder(tmp_path, monkeypatch):
    folder, checks = tmp_path / "run", list[object]()
    check = Run.check_new

    def made_meanwhile(path):
        check(path)
        if not checks:  # after the first look, another process makes the run
            checks.append(path)
            Run.create(folder, replace(RECIPE, seed=1))

    monkeypatch.setattr(Run, "check_new", made_meanwhile)
    with pytest.raises(FileExistsError, match="exists already"):
        Run.create(folder, RECIPE)
    assert Run.open(folder).recipe.seed == 1


def test_a_run_in_use_is_evaluated_into_another_file_only(tmp_path, capsys):
    run = untrained(tmp_path / "run", RECIPE)
    record = runner.Record(RECIPE, make_algorithm(RECIPE)).state_dict()
    run.save(STEPS, {**run.load_trained()[1], "record": record})
    with run:
        with pytest.raises(SystemExit):
            main(["evaluate", str(run.folder)])
        assert "in use by another process" in capsys.readouterr().err
        main(["evaluate", str(run.folder), "--out", str(tmp_path / "elsewhere.json")])
    main(["evaluate", str(run.folder)])
    text = (run.folder / "evaluation.json").read_text()
    assert (tmp_path / "elsewhere.json").read_text() == text
