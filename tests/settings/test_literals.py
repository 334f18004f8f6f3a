"""What is typed is read as literals and names; nothing is run."""

import pytest

from torchrl_tit.settings.literals import parse_assignments, parse_call


def test_assignments():
    assert parse_assignments([]) == {}
    given = ["a=1", "b = 0.5", "c=True", "d=[1, 2]", "e=8x8", "f='8'", "g=", "h=x=y", "i=None"]
    assert parse_assignments(given) == {
        **{"a": 1, "b": 0.5, "c": True, "d": [1, 2], "e": "8x8"},
        **{"f": "8", "g": "", "h": "x=y", "i": None},
    }


@pytest.mark.parametrize(
    ("given", "words"),
    [
        (["a"], "expected NAME=VALUE, .*not 'a'"),
        (["a.b=1"], "not 'a.b=1'"),
        (["a=1", "a=2"], "a is set twice, the second time by 'a=2'"),
        (["a=false"], "'a=false' would be text: write a=False"),
    ],
)
def test_assignments_that_are_none(given, words):
    with pytest.raises(ValueError, match=words):
        parse_assignments(given)


@pytest.mark.parametrize(
    ("given", "target", "arguments"),
    [
        ("a.b:C", "a.b:C", {}),
        (" a:C() ", "a:C", {}),
        ("a:C(n=8, s='x(y)', t=(1, -2.5), )", "a:C", {"n": 8, "s": "x(y)", "t": (1, -2.5)}),
    ],
)
def test_calls(given, target, arguments):
    assert parse_call(given) == (target, arguments)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ("C", "does not name a class: expected module:Class"),
        ("a-b:C", "does not name a class"),
        (":C", "does not name a class"),
        ("a:C(8)", r"need their names, as in Class\(argument=1\)"),
        ("a:C(**{'n': 1})", "need their names"),
        ("a:C(n=m)", "n=m in .* is no literal"),
        ("a:C(n=__import__('os'))", "is no literal"),
        ("a:C(n=1", "not closed"),
        ("a:C(n=1).d", "not those of one call"),
        ("a:C(n=1)(m=2)", "not those of one call"),
    ],
)
def test_calls_that_are_none(given, words):
    with pytest.raises(ValueError, match=words):
        parse_call(given)


@pytest.mark.parametrize("bomb", ["-" * 100_000 + "1", "(" * 100_000], ids=["minus", "open"])
def test_what_is_nested_too_deeply_is_no_literal(bomb):
    assert parse_assignments([f"a={bomb}"]) == {"a": bomb}
    with pytest.raises(ValueError, match="are not closed, or not those of one call"):
        parse_call(f"a:C(n={bomb})")
