"""What the help of every command shows is what was written: nothing is taken for markup."""

from collections.abc import Iterator
from typing import Any

import pytest
import typer
from typer.testing import CliRunner

from psa_casadi.cli.app import app


def commands(own: Any, *path: str) -> Iterator[tuple[tuple[str, ...], Any]]:
    """Yield a command of click, which some versions of typer hold in a room of their own."""
    yield path, own
    for name, inner in getattr(own, "commands", {}).items():
        yield from commands(inner, *path, name)


EVERY = dict(commands(typer.main.get_command(app)))


def written(own: Any) -> list[str]:
    """Return the texts of a command's help, without the backslashes that keep brackets."""
    texts = [own.help, own.epilog, *(getattr(p, "help", None) for p in own.params)]
    return [" ".join(text.replace("\\[", "[").split()) for text in texts if text]


@pytest.mark.parametrize("path", EVERY, ids=" ".join)
def test_the_help_shows_its_texts_with_their_brackets(path: tuple[str, ...]) -> None:
    result = CliRunner().invoke(app, [*path, "--help"], env={"COLUMNS": "500"})
    shown = " ".join(result.output.split())
    assert "\\" not in shown
    assert [text for text in written(EVERY[path]) if text not in shown] == []
