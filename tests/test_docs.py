"""The code that README and docs show, run as by a reader who pastes the blocks of a page one by one.

A block that starts with ```python is run. One with ```py looks the same to readers and is only parsed,
because it needs what is not here, such as a notebook or another package.
"""

import ast
import os
import re
import runpy
import subprocess
import sys
from pathlib import Path

import pytest

import splatax as sx
from gsplat_arguments import ARGUMENTS, tabled_arguments

ROOT = Path(__file__).parents[1]
GENERATED = ROOT / "docs" / "reference.md"
PAGES = [ROOT / "README.md", *sorted({*(ROOT / "docs").glob("*.md")} - {GENERATED})]
RUN = """
import functools, os, pathlib, runpy, sys
import splatax as sx
sx.demo_dataset = functools.partial(sx.demo_dataset, photos=5, width=48, height=36)
for script in map(pathlib.Path, sys.argv[1:]):
    empty = script.with_suffix("")
    empty.mkdir()
    os.chdir(empty)
    runpy.run_path(str(script), run_name="__main__")
"""


SUFFIXES = {".py", ".md", ".toml", ".sh", ".yaml", ".html", ".js", ".h", ".cc", ".cu", ".cuh"}
BUILT = "viewer.js"


def texts() -> list[Path]:
    """All texts of the checkout, apart from what is built and other people's packages."""
    inside = [path for name in ("src", "tests", "docs", "native") for path in (ROOT / name).rglob("*")]
    return [
        path
        for path in [*ROOT.iterdir(), *inside]
        if path.is_file() and (path.suffix in SUFFIXES or path.name == "Makefile") and path.name != BUILT
    ]


def code_of(page: Path, fence: str) -> str:
    """The blocks of a page, each line at its place, so that a traceback has the page's line numbers."""
    lines, inside = [], False
    for line in page.read_text().splitlines():
        if inside and line.startswith("```"):
            inside = False
        lines.append(line if inside else "")
        if line == f"```{fence}":
            inside = True
    assert not inside, f"{page.name}: a block has no end"
    return "\n".join(lines)


def named(page: Path) -> str:
    return str(page.relative_to(ROOT))


RUNNABLE = [page for page in PAGES if code_of(page, "python").strip()]


@pytest.mark.slow
@pytest.mark.parametrize("pages", [RUNNABLE[::2], RUNNABLE[1::2]], ids=["one half", "other half"])
def test_blocks_of_a_page_run_one_after_the_other_in_an_empty_folder(pages, tmp_path):
    """Pages have nothing in common but their process, which imports and compiles once."""
    for page in pages:
        (tmp_path / f"{page.stem}.py").write_text(code_of(page, "python"))
    done = subprocess.run(
        [sys.executable, "-c", RUN, *(tmp_path / f"{page.stem}.py" for page in pages)],
        cwd=tmp_path,
        env=os.environ | {"JAX_PLATFORMS": "cpu", "PYTHONPATH": str(ROOT / "src")},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, f"a page, with its line numbers:\n{done.stderr}"


@pytest.mark.parametrize("page", PAGES, ids=named)
def test_blocks_that_are_not_run_are_python_at_least(page):
    ast.parse(code_of(page, "py"), page.name)


def test_readme_and_resume_have_blocks_that_are_run():
    assert code_of(ROOT / "README.md", "python").strip()
    assert code_of(ROOT / "docs" / "resume.md", "python").strip()


def test_a_block_keeps_its_line_numbers(tmp_path):
    page = tmp_path / "page.md"
    page.write_text("Text\n```python\nfirst\n```\nmore\n```py\nother\n```\n```python\nsecond\n```\n")
    assert code_of(page, "python").split("\n") == ["", "", "first", "", "", "", "", "", "", "second", ""]


def test_the_reference_is_what_the_docstrings_say():
    script = runpy.run_path(str(ROOT / "docs" / "make_reference.py"))
    committed = GENERATED.read_text(encoding="utf-8")
    assert script["page"]() == committed, "run: python docs/make_reference.py"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_to_files_lead_to_files(page):
    targets = re.findall(r"\]\(([^)#:\s]+)(?:#[^)]*)?\)", page.read_text())
    assert [target for target in targets if not (page.parent / target).exists()] == []


def anchor_of(heading: str) -> str:
    """The name that GitHub gives to the place of a heading."""
    text = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", heading.strip().lower()).replace("`", "").replace("*", "")
    return "".join(c for c in text if c.isalnum() or c in " -_").replace(" ", "-")


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_to_sections_lead_to_headings(page):
    missing = []
    for target, anchor in re.findall(r"\]\(([^)#:\s]*\.md|)#([^)\s]+)\)", page.read_text()):
        linked = (page.parent / target).read_text() if target else page.read_text()
        without_code = re.sub(r"```.*?```", "", linked, flags=re.DOTALL)
        if anchor not in {
            anchor_of(heading) for heading in re.findall(r"^#+ (.*)$", without_code, re.MULTILINE)
        }:
            missing.append(f"{target}#{anchor}")
    assert missing == []


def test_a_link_to_a_section_that_does_not_exist_is_found():
    assert (
        anchor_of("Cameras before training: `--adjust-cameras`") == "cameras-before-training---adjust-cameras"
    )
    assert anchor_of("One [step](a.md): `training/step.py`") == "one-step-trainingsteppy"


def test_no_text_installs_a_package_from_an_index_that_does_not_have_it():
    asked = f"{'splatax'}["  # as in a requirement with extras; a checkout is '.[extra]'
    assert [named(path) for path in texts() if asked in path.read_text(encoding="utf-8")] == []


def test_the_newest_part_of_the_changelog_is_that_of_the_present_version():
    newest = next(line for line in (ROOT / "CHANGELOG.md").read_text().splitlines() if line.startswith("## "))
    assert newest.split()[1] == sx.__version__


WIDTH = 120  # characters
UNBROKEN = ("|", "#", "<", "![", "$$")  # tables, headings, HTML, pictures and formulas stay on one line


def too_long(text: str) -> list[int]:
    """The numbers of lines of prose that are too long and could be broken at a space, from 1."""
    found, fenced, before = [], False, ""
    for number, line in enumerate(text.splitlines(), start=1):
        words = line.lstrip()
        if words.startswith("```"):
            fenced = not fenced
        indented = line.startswith("    ") and (not before.strip() or before.startswith("    "))
        breakable = " " in words[: WIDTH - (len(line) - len(words))].removeprefix("- ")
        if len(line) > WIDTH and breakable and not (fenced or indented or words.startswith(UNBROKEN)):
            found.append(number)
        before = line
    return found


@pytest.mark.parametrize("page", [*PAGES, ROOT / "CHANGELOG.md"], ids=named)
def test_lines_of_prose_fit_a_terminal(page):
    assert too_long(page.read_text(encoding="utf-8")) == []


def test_a_long_line_of_prose_is_found_and_a_long_table_code_or_link_is_not():
    long = "word " * 30
    assert too_long(f"{long}\n- {long}\n\n{long}") == [1, 2, 4]
    link = f"https://example.org/{'a' * 120}"
    assert too_long(f"| {long} |\n```\n{long}\n```\n\n    {long}\n\n# {long}\n$$ {long} $$") == []
    assert too_long(f"- {link}\n{link}") == []


def test_each_argument_of_gsplat_has_a_row_in_the_table():
    assert len(ARGUMENTS) == 43
    assert set(ARGUMENTS) <= tabled_arguments()
