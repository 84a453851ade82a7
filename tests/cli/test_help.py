"""The help of every command: texts, names of values, defaults in words, and options in groups."""

import re
from dataclasses import dataclass, fields
from typing import get_type_hints

import pytest

from splatax import cli
from splatax.cli.blocks import MergeBlocks, PlanBlocks, TrainBlock
from splatax.cli.commands import COMMANDS
from splatax.cli.options import flag
from splatax.cli.paragraphs import groups_of

MOST = 12  # options in one group; more in one list are not found by reading
WIDTH = 129  # of the terminal, below which tyro puts all groups in one column
BY_TYPE = {"INT", "FLOAT", "STR", "BOOL"}  # names that say what Python stores, not what a user types
KINDS = {(name,): command.load for name, command in COMMANDS.items() if name != "blocks"} | {
    ("blocks", "plan"): lambda: PlanBlocks,
    ("blocks", "train"): lambda: TrainBlock,
    ("blocks", "merge"): lambda: MergeBlocks,
}


@dataclass(frozen=True)
class Shown:
    """An argument as help shows it."""

    group: str
    name: str
    metavar: str
    text: str


def shown_in(printed):
    """Reads a help text as it is where no boxes can be drawn: each argument, in order."""
    found, group, before = [], "", ""
    for line in printed.splitlines():
        if re.match(r" -{9,} *$", line) and re.match(r" \S", before):
            group = before.strip()
        elif row := re.match(r"  (\S.*?) *$", line):
            called, _, text = re.sub(r"\s{2,}", "\0", row[1], count=1).partition("\0")
            name, _, metavar = called.partition(" ") if called.startswith("--") else (called, "", called)
            found.append(Shown(group, name, metavar, text))
        elif found and (row := re.match(r"   +(\S.*?) *$", line)):
            last = found.pop()
            found.append(Shown(last.group, last.name, last.metavar, f"{last.text} {row[1]}".strip()))
        before = line
    return [each for each in found if re.match("--?[a-z]", each.name) or each.group == "positional arguments"]


def flags_without_value(kind):
    """Names the options of a command that take no value."""
    for owner in (kind, *groups_of(kind)):
        hints = get_type_hints(owner)
        yield from (flag(field.name) for field in fields(owner) if hints[field.name] is bool)


@pytest.fixture(params=KINDS, ids=" ".join)
def shown(request, monkeypatch, capsys):
    """The arguments in the help of a command, and its options that take no value."""
    monkeypatch.setenv("COLUMNS", str(WIDTH))
    with pytest.raises(SystemExit):
        cli.main([*request.param, "--help"])
    kind = KINDS[request.param]()
    return shown_in(capsys.readouterr().out), kind, {"-h, --help", *flags_without_value(kind)}


def test_every_argument_has_a_text_and_every_value_a_name_that_users_understand(shown):
    arguments, kind, valueless = shown
    named = {flag(field.name) for owner in (kind, *groups_of(kind)) for field in fields(owner)}
    assert len(arguments) > len(named) / 2, "the help is read"
    for each in arguments:
        assert len(each.text.split()) > 1, f"{each.name} has no text"
        assert "None" not in each.metavar + each.text.split("(default: ")[-1], f"{each.name}: {each}"
        if each.name not in valueless:
            assert each.metavar, f"{each.name} takes a value that has no name"
            assert not BY_TYPE & set(re.findall(r"[A-Z]+", each.metavar)), f"{each.name}: {each.metavar}"


def test_no_group_has_more_options_than_one_reads(shown):
    arguments, _, _ = shown
    sizes = {}
    for each in arguments:
        if each.name != "-h, --help":
            sizes[each.group] = sizes.get(each.group, 0) + 1
    assert {group: size for group, size in sizes.items() if size > MOST} == {}


def test_a_help_text_is_read_with_its_groups_names_and_continued_lines():
    printed = """\
usage: splatax x [OPTIONS]

 positional arguments
 -----------------------------------
  MODEL       A splat file. (required)

 photos options
 -----------------------------------
  Photos and points to train on.
  ----------------------------------
  --out PATH  File to write. By
              default none.
  --hold-out {every:N,last}
              Photos to score.
  --undistort
"""
    assert shown_in(printed) == [
        Shown("positional arguments", "MODEL", "MODEL", "A splat file. (required)"),
        Shown("photos options", "--out", "PATH", "File to write. By default none."),
        Shown("photos options", "--hold-out", "{every:N,last}", "Photos to score."),
        Shown("photos options", "--undistort", "", ""),
    ]
