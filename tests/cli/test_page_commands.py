import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from typer.main import get_command

import psa_casadi as psa
from build_scripts import copied_pages
from build_scripts.measured_data import ROOT
from build_scripts.page_commands import blocks_of, find_blocks, pages, run_blocks
from psa_casadi.cli.app import app

TEXT = Path(__file__).with_name("commands.md").read_text("utf-8")


#: The pages whose one block a test runs.
IN_TESTS = ["README.md", "docs/howto/fmu_export.md", "docs/howto/own_model.md", "docs/python.md"]


def run_text(text: str) -> list[str]:
    return run_blocks(find_blocks(text))


def test_commands_run_in_an_empty_directory_that_the_next_block_may_share() -> None:
    assert run_text(TEXT) == []
    assert len(run_text(TEXT.replace("<!-- run: continue -->", ""))) == 1


def test_what_pages_show_as_text_is_no_command() -> None:
    for page in pages():
        displayed = re.findall(r"^```(?:text)?\n(.*?)^```", page.read_text("utf-8"), re.M | re.S)
        assert not re.search(r"^(\$ |psa |python |pip |import )", "\n".join(displayed), re.M), page


def spans() -> list[tuple[str, str]]:
    """Return every command of `psa` that a page, a recipe or a message shows within a line."""
    looked_at = [p for p in LOOKED_AT if p.name != "CHANGELOG.md"]
    sources = [*(ROOT / "psa_casadi").rglob("*.py"), *looked_at]
    span = re.compile(r"`(psa [^`\n]+)`")
    return [(p.name, s) for p in sources for s in span.findall(p.read_text(encoding="utf-8"))]


def wrong_word(command: Any, words: list[str]) -> str:
    """Return the first word that a command rejects, "" if it accepts all."""
    while words and (inner := getattr(command, "commands", {}).get(words[0])) is not None:
        command, words = inner, words[1:]
    options = {o: p for p in command.params for o in (*p.opts, *p.secondary_opts) if o[0] == "-"}
    places = [p for p in command.params if p.param_type_name == "argument"]
    rest = iter(w for w in words if w not in ("COMMAND", "--help"))
    for word in rest:
        if not word.startswith("-"):
            if not places and not command.context_settings.get("allow_extra_args"):
                return word
        elif (option := options.get(word)) is None:
            return word
        elif not getattr(option, "is_flag", False):
            for _ in range(option.nargs):
                next(rest, None)
    return ""


def test_every_command_within_a_line_has_the_words_that_it_takes() -> None:
    group = get_command(app)
    result = spans()
    assert len(result) > 100
    wrong = {
        (place, span): word
        for place, span in result
        if (word := wrong_word(group, re.sub(r"[][]|\.\.\.|\{[^}]*\}", "X", span).split()[1:]))
    }
    assert wrong == {}
    assert wrong_word(group, ["export", "fmu", "MODEL.json", "-o", "X"]) == "MODEL.json"
    assert wrong_word(group, ["export", "fmu", "--model", "M", "-o", "X", "--fast"]) == "--fast"


def test_a_block_that_a_test_runs_is_left_to_it() -> None:
    assert run_text(TEXT.replace("run: skip, it ends", "run: in-tests")) == []
    marked = [b.page for p in pages() for b in blocks_of(p) if "in-tests" in b.marks]
    assert list(dict.fromkeys(marked)) == IN_TESTS
    files = ("any_model/test_any_model", "cli/test_cli", "diagnosis/test_measured_rows")
    used = "".join((ROOT / "tests" / f"{n}.py").read_text("utf-8") for n in files)
    assert all(f'_in_tests("{page}")' in used for page in IN_TESTS)


def test_a_command_that_fails_is_named_with_its_line() -> None:
    (failure,) = run_text(
        TEXT.replace("<!-- run: skip, it ends -->", "").replace("$ grep two", "$ true")
    )
    assert failure == "README.md line 5: 'exit 7' ended with exit code 7."
    (failure,) = run_text("```console\n$ false | cat\n$ touch never\n```")
    assert "'false | cat' ended with exit code 1" in failure


def test_a_block_that_needs_data_is_skipped_without_them_except_in_ci(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    text = '<!-- run: needs-data -->\n```console\n$ test -f "$PSA_CASADI_DATA/a.csv"\n```'
    monkeypatch.setenv("PSA_CASADI_DATA", str(tmp_path / "absent"))
    monkeypatch.delenv("CI", raising=False)
    assert run_text(text) == []
    monkeypatch.setenv("CI", "true")
    assert run_text(text) == ["README.md line 2: the measured records are not here."]
    monkeypatch.setenv("PSA_CASADI_DATA", str(tmp_path))
    assert len(run_text(text)) == 1
    (tmp_path / "a.csv").touch()
    assert run_text(text) == []


def test_a_mark_that_does_not_exist_and_a_block_without_end_are_refused() -> None:
    with pytest.raises(ValueError, match="line 1: 'never' is no mark"):
        find_blocks("<!-- run: never -->\n")
    with pytest.raises(ValueError, match="line 1: say why this is skipped"):
        find_blocks("<!-- run: skip -->\n")
    with pytest.raises(ValueError, match="line 2: this block has no end"):
        find_blocks("text\n```console\n$ true\n")


@pytest.mark.parametrize("place", ["plant", "drive", "sensor", "environment"])
def test_the_table_of_effects_is_that_of_the_package(place: str) -> None:
    lines = (ROOT / "docs" / "howto" / "diagnose.md").read_text(encoding="utf-8").splitlines()
    row = next(line for line in lines if line.startswith(f"| {place} | `"))
    items = [e.name for e in psa.EFFECTS.values() if e.belongs_to == place]
    assert re.findall(r"`(\w+)`", row) == items


#: Links of Markdown and HTML; badges lead to pages of the repository's host.
LINK = re.compile(
    r"(?:\]\(|(?:src|href)=\")(?!\w+:|\.\./\.\./actions/)([^)#\"]*)(?:#([^)\"]*))?[)\"]"
)
#: Pages that are looked at on the repository's host, where no site has been built.
LOOKED_AT = [
    *pages(), *ROOT.glob("[A-Z]*.md"), *(ROOT / "psa_casadi" / "examples" / "recipes").glob("*.md")
]  # fmt: skip


def anchors(page: Path) -> set[str]:
    """Return where a link may lead to within a page, as the repository's host names it."""
    text = re.sub(r"^```.*?^```", "", page.read_text(encoding="utf-8"), flags=re.M | re.S)
    headings = (re.sub(r"\]\([^)]*\)", "", h) for h in re.findall(r"^#+ +(.*)$", text, re.M))
    return {re.sub(r"[^\w -]", "", h.strip().lower()).replace(" ", "-") for h in headings}


@pytest.mark.parametrize("page", sorted(set(LOOKED_AT)), ids=lambda p: p.name)
def test_every_link_leads_to_a_file_of_the_repository(page: Path) -> None:
    for target, anchor in LINK.findall(page.read_text(encoding="utf-8")):
        there = (page.parent / target).resolve() if target else page
        assert there.exists(), target
        assert there.is_relative_to(ROOT.resolve()), target
        assert not anchor or anchor in anchors(there), anchor


def test_links_to_recipes_and_notebooks_lead_to_their_pages_in_the_site() -> None:
    linked = "[a](../../psa_casadi/examples/recipes/fmpy.md#x) [b](../tutorials/ci.ipynb) c.ipynb"
    page = SimpleNamespace(file=SimpleNamespace(src_uri="howto/casadi.md"))
    made = copied_pages.on_page_markdown(linked, page=page)
    assert made == "[a](../howto/fmpy.md#x) [b](../tutorials/ci.md) c.ipynb"
    recipes = {Path(t).stem for p in pages() for t, _ in LINK.findall(p.read_text("utf-8"))
               if "examples/recipes" in t}  # fmt: skip
    assert recipes <= set(copied_pages.RECIPES)


def test_the_readme_is_short_and_its_badges_are_of_workflows() -> None:
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    assert len(text.splitlines()) <= 150
    badges = set(re.findall(r"\.\./\.\./actions/workflows/([\w.]+)/badge\.svg", text))
    assert badges <= {path.name for path in (ROOT / ".github" / "workflows").iterdir()}
