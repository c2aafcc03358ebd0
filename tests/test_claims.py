"""docs/claims.md has every sentence that says of itself whether it is proved, and no sentence that nobody prints."""

from __future__ import annotations

import ast
import re
from functools import cache

import pytest
from places import ROOT

ROWS = re.findall(
    r"^\| (.+?) \| (\w+) \| (.+?) \| `([\w.]+)` \|$", (ROOT / "docs" / "claims.md").read_text(), re.MULTILINE
)
FILES = sorted((ROOT / "designer").rglob("*.py"))
MODULES = [".".join(file.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__") for file in FILES]
HELP = {  # what a command or an option is for
    "prove a certificate again, without a solver",
    "gains with a certificate, for a problem",
    "write them as a gains file, their exact gain certified",
    "the largest boxes for which 1.05 gamma is proved, of all shapes; small networks have some anyway",
    "no gains, but a table: the certified gamma with each node and each link left out in turn",
    "the paper's two examples: printed beside computed (a minute or two)",
}
REFUSAL = "certificate: "  # of a file: what is wrong with its form
SAYS = re.compile(r"\b(proved|certified|certificate|computed|REFUTED|floats tell)\b")


@cache
def literals(module: str) -> list[str]:
    """What a module may print: its strings, a formatted one as one with its values left out; no docstrings."""
    file = ROOT / f"{module.replace('.', '/')}.py"
    tree = ast.parse((file if file.exists() else file.with_suffix("") / "__init__.py").read_text())
    inner = {id(part) for node in ast.walk(tree) if isinstance(node, ast.JoinedStr) for part in node.values}
    silent = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
    found = []
    for node in ast.walk(tree):
        if isinstance(node, ast.JoinedStr):
            found.append("".join(part.value for part in node.values if isinstance(part, ast.Constant)))
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and not {id(node)} & (inner | silent):
            found.append(node.value)
    return found


def unlisted(module: str, texts: list[str]) -> list[str]:
    """What says of itself whether it is proved, in words, and is in no row of the module."""
    rows = [sentence for sentence, _, _, of in ROWS if of == module]
    spoken = [text for text in texts if SAYS.search(text) and " " in text.strip()]
    spoken = [text for text in spoken if text not in HELP and not text.startswith(REFUSAL)]
    return [text for text in spoken if not any(sentence in text for sentence in rows)]


def test_the_table_is_read() -> None:
    assert len(ROWS) > 30
    assert {kind for _, kind, _, _ in ROWS} == {"proved", "computed", "assumed"}


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row[0])
def test_what_the_table_has_is_printed(row: tuple[str, str, str, str]) -> None:
    sentence, _, _, module = row
    assert any(sentence in text for text in literals(module))


def test_what_says_whether_it_is_proved_is_in_the_table() -> None:
    assert [(module, text) for module in MODULES for text in unlisted(module, literals(module))] == []


def test_a_new_claim_would_be_found() -> None:
    assert unlisted("designer.show", ["it is proved that the moon is near"]) == ["it is proved that the moon is near"]
