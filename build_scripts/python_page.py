"""Hook of mkdocs: the page of the Python package has every public name below its subject."""

import re
from collections.abc import Iterator
from typing import Any

PAGE = "python.md"
#: Public names by the headings of the page; those of a space are written with it.
SECTIONS = {
    "Records": """Record Signals read_record read_records read_signals record_from write_record
        two_clocks datasets""",
    "Identification": "identify Identification StackIdentification sample Posterior timed Timings",
    "Diagnosis": """diagnose Diagnosis StackDiagnosis load_diagnosis patched_model story report
        write_report write_fit_report save_figure""",
    "Many devices": """batch BatchRun Job Options compare Comparison read_findings write_comparison
        write_population""",
    "Models": """Model stack_model STACKS ode_model fmu_model table compose save_model load_model
        Component Equations Symbols Parameter State Input Output Publication load_effects EFFECTS
        BASE SIMPLIFIED COMPONENTS""",
    "Simulation": """simulate simulate_record simulate_many run settled_at memory_after Trajectory
        linearize Linear margins observer""",
    "Export": """export_fmu check_fmu CheckReport export_modelica export_c CodeExport export_ssp
        export_extended save_start_values""",
    "Systems": """system part_model PARTS connect System nanopositioner controller_for margins_of
        compensator_for""",
    "Control": """online part_for FeedForward AdaptiveFeedForward HysteresisObserver
        OnlineIdentification stack_values identifier_for""",
    "Designs": """design design.design_experiment design.Limits design.separating_experiment
        design.informative_experiment design.resolving_experiment design.usual_records design.track
        design.quickest_move design.AmplifierLimits design_mechanism mechanism_model port_model""",
    "Errors": "PsaError InputError MachineError __version__",
}
#: Namespaces whose names are under the headings above; of `datasets` all are on the page.
SPACES = ("design", "online", "system")
#: Where the docstring of a name is that is made at run time.
_ELSEWHERE = {
    "identify": ("identification.identify.identify", "identification.own_model.identify_ode"),
    "diagnose": ("diagnosis.diagnose.diagnose", "diagnosis.ode.diagnose_ode"),
    "report": ("report.shown.report",),
}
_HEADING = re.compile(r"^## (.+)$", re.MULTILINE)


def on_page_markdown(markdown: str, *, page: Any, **_: Any) -> str:
    """Return the text of a page, the one of the package with its names."""
    return with_names(markdown) if page.file.src_uri == PAGE else markdown


def with_names(markdown: str) -> str:
    """Return the text with the names of each section at its end; every section has its heading."""
    head, *parts = _HEADING.split(markdown)
    texts = dict(zip(parts[::2], parts[1::2], strict=True))
    if list(texts) != list(SECTIONS):
        raise ValueError(f"The headings of {PAGE} are {list(texts)}, not {list(SECTIONS)}.")
    named = ("\n".join([f"## {h}", t.rstrip(), "", *_blocks(h), ""]) for h, t in texts.items())
    return "\n".join([head, *named])


def _blocks(heading: str) -> Iterator[str]:
    for name in SECTIONS[heading].split():
        for place in _ELSEWHERE.get(name, (name,)):
            yield f"::: psa_casadi.{place}"
            if name in SPACES:
                yield "    options:\n      members: false"
