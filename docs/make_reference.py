"""Writes docs/reference.md from the sources: python docs/make_reference.py

It reads the public names from `splatax/__init__.py`, and signatures and docstrings from the modules that
define them. Nothing is imported, so the page does not depend on what is installed.
"""

import ast
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path

PAGE = Path(__file__).with_name("reference.md")
SOURCES = Path(__file__).parents[1] / "src"
WIDTH = 100  # characters of a signature; longer ones get a line for each parameter
SECTION = re.compile(r"(Args|Attributes|Raises|Returns|Yields):")
HEAD = """# Reference

Every public name of `splatax` and of its submodules, with its docstring. After `import splatax as sx`, all of
them can be used as they are written here. `python docs/make_reference.py` generates this page.
"""

Definition = ast.FunctionDef | ast.ClassDef | ast.Assign | ast.AnnAssign


def page() -> str:
    """Returns the whole page as Markdown."""
    homes, submodules = (literal("splatax", name) for name in ("HOMES", "SUBMODULES"))
    package = {name: definition(f"splatax.{home}", name) for name, home in homes.items()}
    modules = {"sx": ("splatax", package)}
    for name, home in submodules.items():
        module = f"splatax.{home}"
        modules[f"sx.{name}"] = module, {public: definition(module, public) for public in names_of(module)}
    contents = [
        f"- [`{title}`](#{title.replace('.', '')}): {', '.join(f'`{name}`' for name in sorted(found))}"
        for title, (_, found) in modules.items()
        if found
    ]
    sections = [section(title, *described) for title, described in modules.items() if described[1]]
    return "\n\n".join([HEAD.strip(), "\n".join(contents), *sections]) + "\n"


def section(title: str, module: str, definitions: dict[str, Definition]) -> str:
    """Returns the part of the page that describes one module."""
    about = markdown(ast.get_docstring(tree_of(module)) or "")
    entries = [entry(f"{title}.{name}", definitions[name]) for name in sorted(definitions)]
    return "\n\n".join([f"## {title}", about, *entries])


def entry(title: str, node: Definition) -> str:
    """Returns the description of one name, and of its methods if it is a class."""
    if isinstance(node, ast.Assign | ast.AnnAssign):
        return f"### {title}\n\n```py\n{ast.unparse(node)}\n```"
    parts = [f"### {title}", f"```py\n{signature(node)}\n```", markdown(ast.get_docstring(node) or "")]
    if isinstance(node, ast.ClassDef):
        methods = [
            part for part in node.body if isinstance(part, ast.FunctionDef) and not part.name.startswith("_")
        ]
        for method in methods:
            about = markdown(ast.get_docstring(method) or "")
            parts.append(f"**{method.name}**\n\n```py\n{signature(method)}\n```\n\n{about}")
    return "\n\n".join(part.strip() for part in parts if part)


def signature(node: ast.FunctionDef | ast.ClassDef) -> str:
    """Returns how a function or method is called, or how a record is made from its fields."""
    if isinstance(node, ast.ClassDef):
        decorators = " ".join(ast.unparse(decorator) for decorator in node.decorator_list)
        fields = [field_of(part) for part in node.body if isinstance(part, ast.AnnAssign)]
        bases = ", ".join(ast.unparse(base) for base in node.bases)
        if "dataclass" not in decorators and "NamedTuple" not in bases:
            return f"class {node.name}({bases})" if bases else f"class {node.name}"
        kept = [field for field in fields if "ClassVar" not in field and not field.startswith("_")]
        return call(f"class {node.name}", kept, "")
    decorators = [ast.unparse(decorator) for decorator in node.decorator_list]
    returns = f" -> {ast.unparse(node.returns)}" if node.returns else ""
    if "property" in decorators:
        return f"{node.name}{returns}"
    parameters = list(parameters_of(node.args))
    if parameters and parameters[0] in ("self", "cls"):
        del parameters[0]
    return call(node.name, parameters, returns)


def field_of(node: ast.AnnAssign) -> str:
    """Returns a field of a record as a parameter, without what `dataclasses.field` says of its storage."""
    name = f"{ast.unparse(node.target)}: {ast.unparse(node.annotation)}"
    value = node.value
    if isinstance(value, ast.Call) and ast.unparse(value.func) == "field":
        options = {option.arg: ast.unparse(option.value) for option in value.keywords}
        default = options.get("default") or (
            f"{options['default_factory']}()" if "default_factory" in options else None
        )
    else:
        default = ast.unparse(value) if value else None
    return name if default is None else f"{name} = {default}"


def parameters_of(arguments: ast.arguments) -> Iterator[str]:
    """Yields the parameters of a function as they are written, with annotations and defaults."""
    positional = [*arguments.posonlyargs, *arguments.args]
    defaults = [None] * (len(positional) - len(arguments.defaults)) + list(arguments.defaults)
    for parameter, default in zip(positional, defaults, strict=True):
        yield written(parameter, default)
    if arguments.vararg:
        yield f"*{written(arguments.vararg, None)}"
    elif arguments.kwonlyargs:
        yield "*"
    for parameter, default in zip(arguments.kwonlyargs, arguments.kw_defaults, strict=True):
        yield written(parameter, default)
    if arguments.kwarg:
        yield f"**{written(arguments.kwarg, None)}"


def written(parameter: ast.arg, default: ast.expr | None) -> str:
    """Returns one parameter as it is written."""
    if default is None:
        return ast.unparse(parameter)
    equals = " = " if parameter.annotation else "="
    return f"{ast.unparse(parameter)}{equals}{ast.unparse(default)}"


def call(name: str, parameters: list[str], returns: str) -> str:
    """Returns a signature on one line, or on a line for each parameter if that is too long."""
    line = f"{name}({', '.join(parameters)}){returns}"
    if len(line) <= WIDTH:
        return line
    return f"{name}(\n" + "".join(f"    {parameter},\n" for parameter in parameters) + f"){returns}"


def markdown(docstring: str) -> str:
    """Returns a docstring with its sections of arguments, results and errors as lists."""
    out: list[str] = []
    title = None
    for line in docstring.splitlines():
        if found := SECTION.fullmatch(line):
            title = found[1]
            out += [f"*{title}*", ""]
        elif title and line and not line.startswith(" "):
            title = None
            out.append(line)
        elif title in (None, "Returns", "Yields"):
            out.append(line.removeprefix("    ") if title else line)
        elif re.match(r"    \S", line):  # an argument or an error
            name, _, text = line.strip().partition(": ")
            out.append(f"- `{name}`: {text}")
        else:
            out.append(line.strip() and f"  {line.strip()}")
    return "\n".join(out)


def definition(module: str, name: str) -> Definition:
    """Returns what defines a name of a module, or of the module that it is imported from.

    Raises:
        LookupError: if there is no such name.
    """
    for node in tree_of(module).body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef) and node.name == name:
            return node
        if isinstance(node, ast.Assign) and name in (ast.unparse(target) for target in node.targets):
            return node
        if isinstance(node, ast.AnnAssign) and ast.unparse(node.target) == name:
            return node
        if isinstance(node, ast.ImportFrom) and name in (alias.asname or alias.name for alias in node.names):
            original = next(alias.name for alias in node.names if name in (alias.asname, alias.name))
            return definition(node.module or "", original)
    raise LookupError(f"{module} has no {name}")


def names_of(module: str) -> list[str]:
    """Returns the public functions and classes of a module, and the names that a package re-exports."""
    names = []
    for node in tree_of(module).body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            names.append(node.name)
        elif isinstance(node, ast.ImportFrom):  # `import x as x` says that x is public
            names += [alias.name for alias in node.names if alias.asname == alias.name]
    return [name for name in names if not name.startswith("_")]


def literal(module: str, name: str) -> dict[str, str]:
    """Returns the value of a table in a module."""
    node = definition(module, name)
    assert isinstance(node, ast.Assign)
    return ast.literal_eval(node.value)


@cache
def tree_of(module: str) -> ast.Module:
    """Returns the parsed source of a module."""
    path = SOURCES.joinpath(*module.split("."))
    source = path / "__init__.py" if path.is_dir() else path.with_suffix(".py")
    return ast.parse(source.read_text(encoding="utf-8"))


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
    print(f"{PAGE}: written")
