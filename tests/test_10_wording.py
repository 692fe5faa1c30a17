"""Lint of wording: reported and unreported phrases."""

import pytest

from website.wording import faults_of_code, faults_of_document


@pytest.mark.parametrize(
    "code",
    [
        '"""What a file contains."""',
        'def f():\n    """Return whether a file exists."""',
        "# nobody configured it",
        "message = f'{name} was told'",
        "asked = 1",
        "def f(told): ...",
    ],
)
def test_dialect_in_code_is_reported_once_with_its_line(code):
    (line, fault), *others = faults_of_code(code)
    assert others == []
    assert line == len(code.splitlines())
    assert fault


@pytest.mark.parametrize(
    "code",
    ['"""Return True if a file exists."""', "# 3 m from the track", "requested = told_by_the_log", "f(asked=1)"],
)
def test_standard_wording_is_not_reported(code):
    assert list(faults_of_code(code)) == []


def test_code_blocks_of_documents_are_not_checked():
    text = "Nobody, `nobody`.\n\n    nobody\n\n```\nnobody\n```\n"
    assert [line for line, _ in faults_of_document(text)] == [1]
