"""Mutants are the errors that their kinds name, and the tests that are next to a file are run for it."""

import ast

from tests.mutation.__main__ import drawn
from tests.mutation.nearest import nearest_files
from tests.mutation.sites import sites
from tests.support.structure import ROOT


def changed(line):
    return {site.kind: site.applied(line) for site in sites(line)}


def test_kinds_change_what_they_name():
    assert changed("a < b")["comparison"] == "(a > b)"
    assert changed("a - b")["sign"] == "((a) + (b))"
    assert changed("a - b")["dropped term"] == "(a)"
    assert changed("a / b")["inverted"] == "((a) * (b))"
    assert changed("-x")["sign"] == "(x)"
    assert changed("R.T")["transposed"] == "R"
    assert changed("A @ B")["order of a product"] == "((B) @ (A))"
    assert changed("p[:, 1]")["off by one"] == "p[:, 2]"
    assert changed("f(0.5)")["1 % of a constant"] == "f(0.505)"
    assert changed("np.sqrt(v)")["variance for standard deviation"] == "(v)"
    assert changed("x.std(ddof=1)")["degrees of freedom"] == "x.std()"
    assert changed("x.std()")["other function"] == "x.var()"
    assert changed("p[keep & near]")["skipped filter"] == "p"


def test_texts_annotations_and_errors_are_left_alone():
    source = 'def f(a: "b[0]") -> "c[1]":\n    """Say 2 + 3."""\n    raise ValueError(f"{a + 1}")\n'
    assert sites(source) == []


def test_drawn_mutants_are_programs_of_many_kinds_and_the_same_for_a_seed():
    folders = ("processor/limits", "processor/registration")
    mutants = drawn(40, 7, folders)
    assert mutants == drawn(40, 7, folders)
    assert len({mutant.site.kind for mutant in mutants}) > 8
    for mutant in mutants:
        source = (ROOT / mutant.path).read_text("utf-8")
        assert source[mutant.site.start : mutant.site.end] == mutant.site.old
        ast.parse(mutant.site.applied(source))


def test_the_nearest_tests_import_the_file():
    nearest = nearest_files("processor/limits/judging.py")
    assert nearest[0].startswith("tests/limits/")
