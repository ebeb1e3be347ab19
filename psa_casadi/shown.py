"""How a result shows itself: made on the floor of reports, asked for where the result lives.

Imports point down, and a picture or a page stands above what it shows. A result only knows the
name of what makes it.
"""

import os
from importlib import import_module
from typing import TYPE_CHECKING, Any, cast

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_HOME = "psa_casadi.report.shown"


class Shown:
    """What a result can show of itself: a line, a notebook's cell, a picture."""

    def __repr__(self) -> str:
        """Return the result in one line."""
        return str(_made("line", self))

    def _repr_html_(self) -> str:
        """Return what a notebook shows: words and picture."""
        return str(_made("cell", self))

    def plot(self) -> "Figure":
        """Return the picture as a matplotlib figure; a notebook shows it by itself."""
        return cast("Figure", _made("plot", self))


class Reported(Shown):
    """What a result can show of itself that has a page of its own."""

    def report(self, path: str | os.PathLike[str], *, still: bool = False) -> None:
        """Write the page, one HTML file below 3 MB that needs no network.

        The model runs in the page unless it is to be `still`.

        Raises:
            InputError: `path` cannot be written to.
        """
        _made("page", self, path, still)


class StillReported(Shown):
    """What a result can show of itself whose page holds no model that runs."""

    def report(self, path: str | os.PathLike[str]) -> None:
        """Write the page, one HTML file below 3 MB that needs no network.

        Raises:
            InputError: `path` cannot be written to.
        """
        _made("page", self, path, True)


def frame(columns: dict[str, Any]) -> Any:
    """Return a pandas DataFrame of columns by name. Raises ImportError that says what to do."""
    try:
        pandas = import_module("pandas")
    except ImportError as error:
        raise ImportError(
            "A data frame needs pandas: run `pip install 'psa-casadi[pandas]'`."
        ) from error
    return pandas.DataFrame(columns)


def _made(what: str, *given: Any) -> Any:
    return getattr(import_module(_HOME), what)(*given)
