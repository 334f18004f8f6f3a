"""Tables of pages say what the data beside them say."""

import pytest

from docs.tools import tables

PAGES = [
    path
    for pattern in tables.PAGES
    for path in sorted(tables.ROOT.glob(pattern))
    if "<!-- table:" in path.read_text()
]
FORM = """<!-- table: hopper
| network | seeds | return | training |
= {1} | {seeds} | {mean} | {between return_mean 900000 2000000}
mlp: MLP
| {paper @ hopper/mlp} | | {counted@sb3.csv CartPole-v1} | |
-->
"""
TABLE = """| network | seeds | return | training |
|---|---|---|---|
| MLP | 0, 1 | 1723 ± 1871† | 1964 |
| near 3530 ± 13 | | 500 ± 0 (5) | |

† Fewer than five seeds: too few for a comparison.
"""


@pytest.mark.parametrize("page", PAGES, ids=lambda path: path.name)
def test_tables_are_those_of_the_data(page):
    text = page.read_text()
    assert text.count("<!-- table:") == text.count("<!-- end -->")
    assert tables.fill(text) == text, "`python -m docs.tools.tables` writes it"


def test_the_pages_with_results_have_tables():
    assert {"README.md", "memory.md", "ppo_settings.md"} <= {page.name for page in PAGES}


@pytest.mark.parametrize("wrong", ["", TABLE, TABLE.replace("1723", "1724")])
def test_a_table_is_written_from_the_data(wrong):
    text = "# A page\n\n{}<!-- end -->\n\nIts end.\n"
    assert tables.fill(text.format(FORM + wrong)) == text.format(FORM + TABLE)


def test_check_names_the_pages_that_differ(tmp_path, monkeypatch, capsys):
    page = tmp_path / "page.md"
    page.write_text(f"{FORM}{TABLE.replace('1723', '1724')}<!-- end -->\n")
    monkeypatch.setattr(tables, "ROOT", tmp_path)
    with pytest.raises(SystemExit):
        tables.main(["--check"])
    assert capsys.readouterr().out == "differ from their data: page.md\n"
    tables.main([])
    assert page.read_text() == f"{FORM}{TABLE}<!-- end -->\n"
    tables.main(["--check"])


@pytest.mark.parametrize(
    ("row", "message"),
    [
        ("gru: GRU", "no run hopper/gru"),
        ("| {means @ hopper/mlp} | | | |", "unknown measure 'means': choose from runs, seeds"),
    ],
)
def test_what_the_data_lack_is_named(row, message):
    with pytest.raises(ValueError, match=message):
        tables.fill(f"{FORM.replace('mlp: MLP', row)}<!-- end -->\n")


def test_measures_over_tasks():
    """Of CartPole, all runs are at the best return, 500."""
    best = tables.measure("overall@ppo_settings/cartpole/*", "")
    assert best == "1 [1, 1]"
    sb3 = "sb3.csv stable_baselines3=2.9.2"
    several = "ppo_settings/cartpole/mlp ppo_settings/mountaincar/mlp ppo_settings/hopper/mlp"
    # CartPole is a tie, and on MountainCar Stable-Baselines3 never sees the goal.
    assert tables.measure(f"improvement@{sb3}", several) == "0.75 [0.75, 0.75]"
    assert tables.measure("overall@sb3.csv MountainCar-v0", "") == "0 [0, 0]"
    with pytest.raises(ValueError, match="no run ppo_settings/nothing"):
        tables.measure("mean", "ppo_settings/cartpole/mlp ppo_settings/nothing")
