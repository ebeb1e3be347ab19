"""Annotations of a Modelica class: its icon and its documentation, from the declarations."""

from collections.abc import Sequence

from psa_casadi.export.common.icon import ICONS, SIDE, Rectangle
from psa_casadi.export.common.markup import describe, generation_tool
from psa_casadi.export.modelica.words import escaped, string
from psa_casadi.model.compose import Model


def icon(name: str) -> list[str]:
    """Return the lines of an Icon annotation of one of the drawings in `ICONS`, and its label."""
    label = 'Text(extent={{-150, 140}, {150, 105}}, textString="%name", textColor={0, 0, 255})'
    shapes = [*map(_rectangle, ICONS[name]), label]
    lines = [f"    {shape}," for shape in shapes]
    lines[-1] = lines[-1].removesuffix(",")
    return ["  annotation(Icon(graphics={", *lines, "  }));"]


def _rectangle(shape: Rectangle) -> str:
    """Return a rectangle in a Modelica icon's coordinates, -100 to 100 with y upward."""
    left, right = (_across(x) for x in (shape.left, shape.left + shape.width))
    top, bottom = (0.0 - _across(y) for y in (shape.top, shape.top + shape.height))
    red, green, blue = (int(shape.colour[i : i + 2], 16) for i in (1, 3, 5))
    colour = f"{{{red}, {green}, {blue}}}"
    corners = f"{{{{{left:g}, {bottom:g}}}, {{{right:g}, {top:g}}}}}"
    fill = f"lineColor={colour}, fillColor={colour}, fillPattern=FillPattern.Solid"
    return f"Rectangle(extent={corners}, {fill})"


def _across(place: int) -> float:
    """Return where a place between 0 and SIDE is between -100 and 100."""
    return round(200 * place / SIDE - 100, 1)


def documentation(paragraphs: Sequence[str], table: str = "") -> str:
    """Return a Documentation annotation of paragraphs, plain texts, and a table in HTML."""
    body = "".join(f"<p>{escaped(p)}</p>\n" for p in paragraphs if p)
    return f"Documentation(info={string(f'<html>{chr(10)}{body}{table}</html>')})"


def equations_table(model: Model) -> str:
    """Return an HTML table of the components: what they are, their equations, their sources."""
    heads = "".join(f"<th>{h}</th>" for h in ("component", "what it is", "equation", "source"))
    rows = [
        (c.name, c.description, c.equation_text, c.source.rstrip(".")) for c in model.components
    ]
    lines = [f"<tr>{''.join(f'<td>{escaped(cell)}</td>' for cell in row)}</tr>" for row in rows]
    return "\n".join(["<table>", f"<tr>{heads}</tr>", *lines, "</table>", ""])


def about(model: Model) -> list[str]:
    """Return what the model is, who publishes it on what terms, and which program wrote it."""
    said = "; ".join(f"{name}: {text}" for name, text in model.publication.stated.items())
    return [describe(model), said, f"Written by {generation_tool()}."]
