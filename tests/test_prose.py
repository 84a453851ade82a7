"""Docstrings of public names open with a sentence that stands without the name.

The rule: the docstring of a public module, class, function or attribute does not open with a preposition, a
conjunction or a relative pronoun, which need a subject that only the name supplies ("Of the loss of a view.",
"What a camera sees."). A function opens with a verb in the third person ("Returns", "Projects"); a class, a
property or a module opens with a noun phrase. A name is public if no part of its path starts with "_".
"""

import ast
import re
from dataclasses import fields
from pathlib import Path

import pytest

import splatax
from splatax.cli.commands import COMMANDS
from splatax.cli.options import flag
from splatax.cli.paragraphs import groups_of

ROOT = Path(splatax.__file__).parent
# Plurals that look like verbs in the third person. "Xs of ..." is a noun phrase, whatever X is.
NOUNS = re.compile(
    """areas|arrays|axes|bounds|boxes|bytes|cameras|centres|channels|colours|coordinates|corners|degrees|depths
    |derivatives|differences|directions|distances|errors|fields|fractions|frames|gaussians|gradients|images
    |indices|joints|lengths|levels|measurements|metres|milliseconds|moments|normals|numbers|options|pairs
    |parameters|paths|photos|pixels|points|poses|positions|radii|rates|rays|rotations|rows|seconds|settings
    |sizes|splats|statistics|tiles|values|variances|vectors|vertices|views""",
    re.IGNORECASE | re.VERBOSE,
)
FORBIDDEN = re.compile(
    """about|above|after|against|along|among|and|around|as|at|because|before|behind|below|beside|between|beyond
    |but|by|during|except|for|from|how|if|in|inside|into|like|near|of|off|on|onto|or|out|outside|over|per|since
    |so|such|than|that|though|through|throughout|till|to|toward|towards|under|until|up|upon|via|what|when|where
    |whether|which|while|who|whom|whose|why|with|within|without""",
    re.IGNORECASE | re.VERBOSE,
)


def public_docstrings(tree):
    """Yields (name, kind, docstring) of the public names in a syntax tree, the module's own first."""
    if (text := ast.get_docstring(tree)) is not None:
        yield "module", "module", text
    yield from _inside(tree, "")


def _inside(node, prefix):
    for child in ast.iter_child_nodes(node):
        if isinstance(child, (ast.If, ast.Try, ast.With)):
            yield from _inside(child, prefix)
        if not isinstance(child, (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef)):
            continue
        if child.name.startswith("_"):
            continue
        if (text := ast.get_docstring(child)) is not None:
            yield prefix + child.name, _kind(child), text
        if isinstance(child, ast.ClassDef):
            yield from _attributes(child, f"{prefix}{child.name}.")
            yield from _inside(child, f"{prefix}{child.name}.")


def _kind(node):
    if isinstance(node, ast.ClassDef):
        return "class"
    decorators = [ast.unparse(decorator) for decorator in node.decorator_list]
    return "property" if any(d.endswith(("property", ".setter")) for d in decorators) else "function"


def _attributes(node, prefix):
    """Yields the strings that follow an assignment in a class body, which document an attribute."""
    for before, after in zip(node.body, node.body[1:], strict=False):
        if isinstance(before, (ast.Assign, ast.AnnAssign)) and isinstance(after, ast.Expr):
            target = before.target if isinstance(before, ast.AnnAssign) else before.targets[0]
            if isinstance(after.value, ast.Constant) and isinstance(after.value.value, str):
                yield prefix + ast.unparse(target), "attribute", after.value.value


def faults(source):
    """Lists what is wrong with the docstrings of a module."""
    found = []
    for name, kind, text in public_docstrings(ast.parse(source)):
        first = text.split()[0].strip("\"'`*,.:;()[]") if text.split() else ""
        if FORBIDDEN.fullmatch(first):
            found.append(f"{name}: opens with {first!r}")
        elif kind == "function" and not (first.isalpha() and first[0].isupper() and first.endswith("s")):
            found.append(f"{name}: a function opens with a verb in the third person, not {first!r}")
        elif kind == "function" and (NOUNS.fullmatch(first) or text.split()[1:2] == ["of"]):
            found.append(f"{name}: a function opens with a verb, and {first!r} is a noun")
    return found


@pytest.mark.parametrize(
    "path", [pytest.param(p, id=str(p.relative_to(ROOT))) for p in sorted(ROOT.rglob("*.py"))]
)
def test_docstrings_of_public_names_open_with_a_sentence(path):
    assert not faults(path.read_text())


@pytest.mark.parametrize(
    ("source", "fault"),
    [
        ('"""What is drawn."""', "opens with 'What'"),
        ('def key():\n    """Of the steps."""', "opens with 'Of'"),
        ('def key():\n    """The key of a step."""', "third person"),
        ('def key():\n    """`key` of a step."""', "third person"),
        ('def keys():\n    """Keys of a step."""', "'Keys' is a noun"),
        ('def axes():\n    """Rows: right and up."""', "'Rows' is a noun"),
        ('class Key:\n    """So many times as many."""', "opens with 'So'"),
        ('class Key:\n    seed: int\n    """Of all randomness."""', "Key.seed: opens with 'Of'"),
        (
            'class Key:\n    @property\n    def old(self):\n        """Whether it is old."""',
            "opens with 'Whether'",
        ),
    ],
)
def test_fragments_are_found(source, fault):
    (found,) = faults(source)
    assert fault in found


@pytest.mark.parametrize(
    "source",
    [
        '"""Scenes to time."""',
        'def count():\n    """Counts the keys of a step."""',
        'class Key:\n    @property\n    def rows(self):\n        """Rows of the key."""',
        'def key():\n    """Returns the key of a step."""',
        'def _key():\n    """Of the steps."""',
        'class Key:\n    @property\n    def old(self):\n        """True if the key was used."""',
        'class _Key:\n    def old(self):\n        """Of the steps."""',
    ],
)
def test_sentences_and_private_names_pass(source):
    assert faults(source) == []


CHECKOUT = Path(__file__).parents[1]
TEXTS = [
    *(CHECKOUT / name for name in ("README.md", "CHANGELOG.md", "Makefile")),
    *sorted((CHECKOUT / "docs").glob("*.md")),
    *sorted((ROOT / "cli").glob("*.py")),
]
ARCHAIC = re.compile(
    r"\b(shall|anew|thereof|mend(s|ed)?|(is|are) but (a|an|the|one)|so as to|comes to the same)\b"
    r"|without it:",
    re.IGNORECASE,
)


@pytest.mark.parametrize("path", TEXTS, ids=lambda path: path.name)
def test_docs_and_help_use_no_archaic_words(path):
    assert [found.group() for found in ARCHAIC.finditer(path.read_text())] == []


def test_archaic_words_are_found():
    assert ARCHAIC.search("It is but a number.")
    assert ARCHAIC.search("The seed. Without it: 0.")
    assert not ARCHAIC.search("It is a recommended button, but a number would do.")


OWN_FLAG = re.compile(r"(?<![\w-])--[a-z][a-z0-9-]*")
COPIED = {"viewer/panels.py"}  # shows a command to copy, with the numbers of a box


def flags_of(kinds):
    """Lists the options of commands, those of their groups and of their own commands too."""
    for kind in kinds:
        yield from (flag(field.name) for field in fields(kind))
        yield from flags_of(groups_of(kind))


def strings_in(source):
    """Yields the string constants of a module with their lines, docstrings and parts of f-strings too."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            yield node.lineno, node.value


def test_the_library_never_speaks_of_command_line_flags():
    """It says what is wrong; the command adds which flag helps. The flags of other programs are fine."""
    own = set(flags_of(command.load() for command in COMMANDS.values()))
    assert {"--out", "--sh-degree", "--blocks", "--clear", "--budget"} <= own
    library = {str(path.relative_to(ROOT)): path for path in ROOT.rglob("*.py") if path.parent.name != "cli"}
    found = [
        f"{name}:{line} {said}"
        for name, path in library.items()
        if name not in COPIED
        for line, text in strings_in(path.read_text())
        for said in OWN_FLAG.findall(text)
        if said in own
    ]
    assert found == []


def test_a_flag_in_part_of_a_message_is_found():
    ((_, text),) = strings_in('f"{city}: trained for another plan: --overwrite."')
    assert OWN_FLAG.findall(text) == ["--overwrite"]
    assert OWN_FLAG.findall("a run -- of one -v step--by--step") == []
