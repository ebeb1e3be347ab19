"""A posterior in words and a table, for the terminal and a notebook."""

from psa_casadi.posterior.sample import Posterior
from psa_casadi.report.words.phrases import number, shown_in
from psa_casadi.report.words.tables import Table
from psa_casadi.report.words.text import labelled, records_text
from psa_casadi.units import convert


def posterior_table(found: Posterior) -> Table:
    """Return every parameter with mean, sd, 94 % interval, effective draws and r-hat."""
    rows = []
    for f in found.figures:
        unit, display = shown_in(found.model, f.name)
        mean, low, high = (convert(x, unit, display) for x in (f.mean, f.low, f.high))
        spread = convert(f.mean + f.sd, unit, display) - mean
        rows.append(
            (
                f.name,
                number(mean, 4),
                number(spread),
                f"{number(low, 4)} to {number(high, 4)}",
                display,
                f"{f.ess:.0f}",
                f"{f.r_hat:.3f}",
                found.model.parameter(f.name).description,
            )
        )
    head = ("parameter", "mean", "sd", "94 % interval", "unit", "ess", "r-hat", "meaning")
    return Table(head, tuple(rows))


def posterior_text(found: Posterior, *, origin: str = "measured", width: int = 100) -> str:
    """Return a posterior: records, chains, the parameters, warnings."""
    drawn = f"{found.chains} chains of {found.draws} draws, {found.divergences} divergent"
    head = [("records", records_text(found.task.experiments, origin)), ("drawn", drawn)]
    tail = [("warning", w) for w in found.warnings] + [("note", n) for n in found.sentences]
    blocks = ["\n".join(labelled(label, text, width) for label, text in head)]
    blocks.append(posterior_table(found).fitted(width))
    blocks += ["\n".join(labelled(label, text, width) for label, text in tail)] if tail else []
    return "\n\n".join(blocks)
