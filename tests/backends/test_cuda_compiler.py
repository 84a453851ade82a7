"""The kernels compile for every GPU that is supported, and are compiled once. No GPU is needed."""

import os
import re

import pytest

from splatax.backends.cuda import nvrtc, programs

CAPABILITIES = (75, 80, 86, 89, 90, 100, 120)  # Turing, Ampere, Ada, Hopper, Blackwell
OLDEST_AND_NEWEST = (75, 120)  # those between are left to `make slow`
# A multiprocessor has 65,536 registers: with 64 a thread, four blocks of 256 threads are resident.
MOST_REGISTERS = 64
MORE_REGISTERS = {"project_gradient": 128}  # the whole chain rule of a Gaussian, in one thread
PLAIN = r"^KERNEL __launch_bounds__\(BLOCK_SIZE\)\s+(\w+)\(\w+ \w+[,)]"  # no template
KERNEL = re.compile(
    r"Function properties for (?P<name>\w+).*?(?P<stack>\d+) bytes stack frame, "
    r"(?P<stores>\d+) bytes spill stores, (?P<loads>\d+) bytes spill loads.*?"
    r"Used (?P<registers>\d+) registers",
    re.DOTALL,
)


@pytest.fixture(scope="module")
def compiler():
    path = nvrtc.find()
    if path is None:
        pytest.skip(f"NVRTC is not installed: pip install {nvrtc.WHEELS[12]}")
    return nvrtc.load(path)


@pytest.mark.parametrize(
    "capability",
    [pytest.param(c, marks=[] if c in OLDEST_AND_NEWEST else pytest.mark.slow) for c in CAPABILITIES],
)
def test_all_kernels_compile_without_spills_and_within_their_registers(compiler, capability):
    options = (f"--gpu-architecture=sm_{capability}", "--ptxas-options=-v", *programs.OPTIONS)
    compiled = compiler.compile(programs.sources(), programs.MAIN, options)
    assert compiled.binary.startswith(b"\x7fELF")
    found = {match["name"]: match for match in KERNEL.finditer(compiled.log)}
    text = "".join(programs.sources().values())
    plain = set(re.findall(PLAIN, text, re.MULTILINE))
    assert {"project", "count_tiles", "photometric_loss", "move_rows"} <= plain - {"NAME"}
    assert plain - {"NAME"} <= set(found)
    for name, match in found.items():
        assert (match["stack"], match["stores"], match["loads"]) == ("0", "0", "0"), name
        assert int(match["registers"]) <= MORE_REGISTERS.get(name, MOST_REGISTERS), name


def test_newer_gpus_get_text_that_their_driver_compiles(compiler):
    newest = max(compiler.capabilities)
    options = (f"--gpu-architecture={programs.architecture(newest + 50, compiler.capabilities)}",)
    text = compiler.compile(programs.sources(), programs.MAIN, (*options, *programs.OPTIONS)).binary
    assert f".target sm_{newest}".encode() in text
    assert text.endswith(b"\0")  # the driver takes PTX as a text that ends in zero


def test_what_does_not_compile_is_reported_with_the_compilers_words(compiler):
    with pytest.raises(nvrtc.CompileError, match='identifier "undeclared" is undefined'):
        compiler.compile({"a.cu": "int f() { return undeclared; }"}, "a.cu", ("--gpu-architecture=sm_90",))


def test_nvrtc_of_another_version_of_cuda_is_not_taken():
    assert nvrtc.find(major=7) is None


# --- what is compiled for a GPU ---


@pytest.mark.parametrize(
    ("capability", "expected"), [(75, "sm_75"), (90, "sm_90"), (88, "compute_80"), (130, "compute_90")]
)
def test_a_gpu_that_the_compiler_does_not_know_gets_text_for_the_newest_one_below_it(capability, expected):
    assert programs.architecture(capability, known=(50, 70, 75, 80, 90)) == expected


def test_a_gpu_that_is_too_old_is_refused():
    with pytest.raises(ValueError, match=r"has compute capability 7\.0, and the kernels need 7\.5"):
        programs.architecture(70, known=(50, 70, 75, 80))


# --- compiled kernels on disk ---


class Counting(nvrtc.Nvrtc):
    """A compiler that says how often it was asked."""

    def __init__(self, version=(12, 9)):  # loads nothing
        self.version, self.capabilities, self.calls = version, (75, 80, 90), 0

    def compile(self, sources, main, options):
        self.calls += 1
        return nvrtc.Compiled(f"{self.version} {options}".encode(), "")


def test_kernels_are_compiled_once(tmp_path):
    first, second = Counting(), Counting()
    assert programs.program(first, 90, tmp_path) == programs.program(second, 90, tmp_path)
    assert (first.calls, second.calls) == (1, 0)
    assert len(list(tmp_path.iterdir())) == 1  # no partial file is left


def test_another_gpu_compiler_or_source_has_another_file(tmp_path, monkeypatch):
    programs.program(Counting(), 90, tmp_path)
    programs.program(Counting(), 80, tmp_path)
    programs.program(Counting((13, 0)), 90, tmp_path)
    monkeypatch.setattr(programs, "sources", lambda: {"kernels.cu": "other"})
    programs.program(Counting(), 90, tmp_path)
    assert len(list(tmp_path.iterdir())) == 4


@pytest.mark.parametrize("damage", [lambda b: b[:-1], lambda b: b[:5], lambda b: b"", lambda b: b + b"x"])
def test_a_damaged_file_is_compiled_again(tmp_path, damage):
    wanted = programs.program(Counting(), 90, tmp_path)
    (path,) = tmp_path.iterdir()
    path.write_bytes(damage(path.read_bytes()))
    again = Counting()
    assert programs.program(again, 90, tmp_path) == wanted
    assert again.calls == 1


def test_kernels_that_cannot_be_kept_are_used_with_a_warning(tmp_path):
    (tmp_path / "file").write_text("not a folder")
    with pytest.warns(UserWarning, match="cannot be kept .* Set XDG_CACHE_HOME"):
        assert programs.program(Counting(), 90, tmp_path / "file" / "folder")


def test_kernels_are_kept_in_the_users_cache(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", os.fspath(tmp_path))
    assert programs.user_folder() == tmp_path / "splatax" / "cuda"
