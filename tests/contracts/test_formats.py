"""The rules for every splat format: it keeps the scene, and refuses damaged files."""

import resource
from contextlib import contextmanager
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial import cKDTree

import splatax as sx
from scenes import camera_at, random_gaussians
from splatax.errors import FormatError
from splatax.io import formats
from splatax.io.formats.marks import MARKS, MIP
from splatax.metrics import psnr, to_8bit

WRITTEN = formats.WRITTEN
READ_ALONE = {".ksplat": "minimal.ksplat", ".spz": "minimal-v2.spz", "4.spz": "minimal-v4.spz"}


@pytest.fixture(params=WRITTEN)
def suffix(request):
    return request.param


def scene(n=500, degree=3, spread=1.0):
    """Ordinary numbers: colours and opacities that any format has levels for."""
    gaussians = random_gaussians(n=n, degree=degree, spread=spread, scale=(0.02, 0.1))
    rng = np.random.default_rng(1)
    bounded = np.concatenate([rng.uniform(-1.5, 1.5, (n, 1, 3)), rng.uniform(-0.3, 0.3, (n, 24, 3))], axis=1)
    return replace(gaussians, sh=jnp.asarray(bounded[:, : (degree + 1) ** 2], jnp.float32))


def in_order_of(loaded, original):
    """Rows of `loaded` in the order of `original`: a format may sort them."""
    distances, rows = cKDTree(np.asarray(loaded.means)).query(np.asarray(original.means))
    assert sorted(rows) == list(range(len(original)))
    return jax.tree.map(lambda leaf: leaf[rows], loaded), distances


def degrees_between(a, b):
    a, b = (np.asarray(q, np.float64) for q in (a, b))
    a, b = (q / np.linalg.norm(q, axis=1, keepdims=True) for q in (a, b))
    same = np.minimum(np.linalg.norm(a - b, axis=1), np.linalg.norm(a + b, axis=1))
    return np.degrees(4 * np.arcsin(np.clip(same / 2, 0, 1)))


@pytest.mark.parametrize("degree", [0, 1, 2, 3, 4])
def test_a_scene_returns_within_the_tolerance_that_the_format_states(tmp_path, suffix, degree):
    module = formats.FORMATS[suffix]
    original = scene(degree=degree)
    if degree > module.MAX_SH_DEGREE:
        with pytest.raises(FormatError, match=f"Reduce it to degree {module.MAX_SH_DEGREE}"):
            sx.save(tmp_path / f"scene{suffix}", original)
        return
    sx.save(tmp_path / f"scene{suffix}", original)
    loaded, distances = in_order_of(sx.load(tmp_path / f"scene{suffix}"), original)
    limit = module.TOLERANCE
    rounding = 1e-6
    assert distances.max() <= limit.means * 2 + rounding
    assert degrees_between(loaded.quats, original.quats).max() <= limit.degrees + 1e-5
    assert_allclose(loaded.log_scales, original.log_scales, atol=limit.log_scales, rtol=0)
    assert_allclose(loaded.opacities, original.opacities, atol=limit.opacities, rtol=0)
    assert_allclose(loaded.sh[:, :1], original.sh[:, :1], atol=limit.dc, rtol=0)
    if limit.sh is None:
        assert loaded.sh_degree == 0
    else:
        assert_allclose(loaded.sh[:, 1:], original.sh[:, 1:], atol=limit.sh, rtol=0)


def test_pictures_of_the_scene_look_the_same(tmp_path, suffix):
    """Of a scene far from the origin and seen from the side, so that frames and harmonics must be right."""
    module = formats.FORMATS[suffix]
    original = scene(degree=0 if module.TOLERANCE.sh is None else 3)
    original = replace(original, means=original.means + jnp.array([[3.0, -2.0, 5.0]]))
    sx.save(tmp_path / f"scene{suffix}", original)
    camera = camera_at((1.0, -3.0, 2.0), (3.0, -2.0, 5.0), size=(64, 48), focal=50.0)
    before, after = (
        to_8bit(np.asarray(sx.render(g, camera).rgb))
        for g in (original, sx.load(tmp_path / f"scene{suffix}"))
    )
    assert before.std() > 20
    assert psnr(after, before) > 36  # several levels of 8 bits in a pixel here and there


def test_saving_what_was_loaded_changes_no_picture_again(tmp_path, suffix):
    """Rounded numbers are rounded to themselves, or nearly: generations do not add up."""
    sx.save(tmp_path / f"first{suffix}", scene())
    first = sx.load(tmp_path / f"first{suffix}")
    sx.save(tmp_path / f"second{suffix}", first)
    camera = camera_at((1.0, -1.0, -3.5), size=(64, 48), focal=50.0)
    pictures = [
        to_8bit(np.asarray(sx.render(g, camera).rgb)) for g in (first, sx.load(tmp_path / f"second{suffix}"))
    ]
    assert psnr(*pictures) > 42


def test_flat_and_opaque_and_unnormalized_gaussians_stay_finite(tmp_path, suffix):
    original = scene(n=6)
    original = replace(
        original,
        log_scales=original.log_scales.at[0].set(-jnp.inf).at[1, 2].set(-jnp.inf).at[2].set(-30.0),
        opacity_logits=original.opacity_logits.at[3].set(80.0).at[4].set(-80.0),
        quats=original.quats.at[5].set(0.0).at[0].multiply(1e-3).at[1].multiply(1e6),
    )
    sx.save(tmp_path / f"scene{suffix}", original)
    loaded = sx.load(tmp_path / f"scene{suffix}")
    assert len(loaded) == 6
    for leaf in (loaded.means, loaded.quats, loaded.opacity_logits, loaded.sh):
        assert np.isfinite(leaf).all()
    assert not np.isnan(loaded.log_scales).any()
    assert np.sort(loaded.opacities)[-1] > 0.99


def test_fully_opaque_gaussians_are_kept_and_counted(tmp_path, suffix, recwarn):
    """SuperSplat writes an opacity of 1 as a logit of +inf. Each format keeps the nearest that it has."""
    logits = jnp.array([jnp.inf, 0.5, jnp.inf, -jnp.inf, jnp.nan, jnp.inf])
    original = replace(scene(n=6), opacity_logits=logits)
    assert sx.save(tmp_path / f"scene{suffix}", original) == 4  # without the empty slot and the broken one
    assert [str(warning.message).split(": ")[1] for warning in recwarn] == [
        "left out 1 Gaussians that are not finite"
    ]
    loaded = sx.load(tmp_path / f"scene{suffix}")
    limit = formats.FORMATS[suffix].TOLERANCE
    assert_allclose(np.sort(loaded.opacities), [jax.nn.sigmoid(0.5), 1, 1, 1], atol=limit.opacities)
    if limit.opacities == 0:
        assert np.isposinf(loaded.opacity_logits).sum() == 3


def test_harmonics_that_are_all_zero_do_not_tint(tmp_path, suffix):
    """A trainer unlocks bands one by one: a short run has zeros."""
    original = scene()
    original = replace(original, sh=original.sh.at[:, 1:].set(0.0))
    sx.save(tmp_path / f"scene{suffix}", original)
    assert_allclose(sx.load(tmp_path / f"scene{suffix}").sh[:, 1:], 0.0, atol=1e-6)


def test_one_gaussian_is_a_scene(tmp_path, suffix):
    sx.save(tmp_path / f"scene{suffix}", scene(n=1))
    assert_allclose(sx.load(tmp_path / f"scene{suffix}").means, scene(n=1).means, atol=2e-4)


@pytest.mark.parametrize(
    "low_pass",
    [
        sx.Dilation(),
        sx.Antialiasing(),
        sx.AlongRays(),
        sx.Antialiasing(0.1),
        sx.Dilation(0.0),
        sx.AlongRays(1.5),
    ],
)
def test_a_scene_is_loaded_with_the_filter_that_it_was_saved_with(tmp_path, suffix, low_pass):
    path, kept = tmp_path / f"scene{suffix}", formats.FORMATS[suffix].KEPT_MARKS
    given = replace(scene(n=3), low_pass=low_pass)
    if kept == MARKS or low_pass in (sx.Dilation(), *([sx.Antialiasing()] if MIP in kept else [])):
        sx.save(path, given)
        assert sx.load(path).low_pass == low_pass
    else:
        with pytest.warns(
            UserWarning,
            match=r"the scene was (trained with antialiasing|drawn along rays|filtered with \d)",
        ):
            sx.save(path, given)


@pytest.mark.parametrize("order", sx.order.ORDERS)
def test_a_scene_is_loaded_with_the_order_that_it_was_saved_with(tmp_path, suffix, order):
    path, given = tmp_path / f"scene{suffix}", replace(scene(n=3), order=order)
    if order == "depth" or formats.FORMATS[suffix].KEPT_MARKS == MARKS:
        sx.save(path, given)
        assert sx.load(path).order == order
    else:
        with pytest.warns(UserWarning, match="the scene was trained in the order of distances"):
            sx.save(path, given)
        assert sx.load(path).order == "depth"


def test_a_variance_that_is_none_is_refused(tmp_path):
    path = tmp_path / "scene.ply"
    sx.save(path, replace(scene(n=3), low_pass=sx.Antialiasing(0.1)))
    path.write_bytes(path.read_bytes().replace(b"variance: 0.1", b"variance: -.1"))
    with pytest.raises(sx.FormatError, match=r"variance of -\.1"):
        sx.load(path)


def test_a_failed_write_leaves_the_old_file(tmp_path, suffix, monkeypatch):
    path = tmp_path / f"scene{suffix}"
    sx.save(path, scene(n=3))
    before, files = path.read_bytes(), sorted(tmp_path.rglob("*"))
    monkeypatch.setattr("os.fsync", lambda file: (_ for _ in ()).throw(OSError("no space left")))
    with pytest.raises(OSError, match="no space"):
        sx.save(path, scene(n=4))
    assert path.read_bytes() == before
    assert sorted(tmp_path.rglob("*")) == files


def test_what_saving_loses_is_one_sentence_after_a_colon(suffix):
    loses = formats.FORMATS[suffix].LOSES
    assert loses[0].islower()
    assert loses.endswith(".")
    assert loses.count(". ") == 0


# --- files that are not what they claim ---


@pytest.fixture(params=[*WRITTEN, *READ_ALONE])
def sound(request, tmp_path):
    """A path with the right suffix, and the bytes of a good file."""
    if request.param in READ_ALONE:
        source = request.getfixturevalue("data") / "splats" / READ_ALONE[request.param]
        return tmp_path / source.name, source.read_bytes()
    path = tmp_path / f"scene{request.param}"
    sx.save(path, scene(n=40))
    return path, path.read_bytes()


@contextmanager
def little_memory(extra=2 << 30):
    """Asking for gigabytes fails, in place of the machine."""
    with open("/proc/self/statm") as file:
        used = int(file.read().split()[0]) * resource.getpagesize()
    old = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (used + extra, old[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, old)


def refused_or_read(path, contents):
    """Nothing but a scene or a `FormatError` with the path may come out."""
    path.write_bytes(contents)
    with little_memory():
        try:
            gaussians = sx.load(path)
            formats.comments(path)
        except FormatError as error:
            if isinstance(error.__cause__, MemoryError):
                pytest.fail(f"it asked for gigabytes: {error}")
            sentence = str(error)
            gaussians = None
    if gaussians is None:
        assert str(path) in sentence
        assert "\n" not in sentence
        return None
    shapes = {leaf.shape[0] for leaf in jax.tree.leaves(gaussians)}
    assert len(shapes) == 1
    return gaussians


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*extensions are not read")
def test_a_file_cut_anywhere_is_refused(sound):
    path, contents = sound
    if path.suffix == ".splat":  # rows without a header: a cut between rows is a smaller scene
        cuts = [n for n in range(1, len(contents)) if n % 32]
    else:
        cuts = {0, 1, 3, 4, 8, 12, 15, 16, 20, 31, 32, 40, len(contents) - 1, len(contents) - 2}
        cuts |= set(np.linspace(0, len(contents) - 1, 60).astype(int).tolist())
    for cut in sorted(cuts):
        if cut < len(contents):
            assert refused_or_read(path, contents[:cut]) is None, f"the first {cut} of {len(contents)} bytes"


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*extensions are not read")
@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@pytest.mark.parametrize("seed", range(3))
def test_flipped_bytes_are_refused_or_read_as_something(sound, seed):
    path, contents = sound
    rng = np.random.default_rng(seed)
    for trial in range(60):
        damaged = bytearray(contents)
        region = (64, 600, len(contents))[trial % 3]  # headers are damaged most often
        for place in rng.integers(0, min(region, len(contents)), rng.integers(1, 5)):
            damaged[place] = (
                rng.integers(256) if rng.random() < 0.5 else damaged[place] ^ 1 << rng.integers(8)
            )
        refused_or_read(path, bytes(damaged))


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*extensions are not read")
@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_counts_of_billions_ask_for_no_memory(sound):
    path, contents = sound
    values = (b"\xff\xff\xff\xff", b"\xff\xff\xff\x7f", b"\x00\x00\x00\x10")
    for place in range(0, min(400, len(contents) - 4)):
        for value in values if place < 64 else values[place % 3 :][:1]:  # most counts stand at the beginning
            refused_or_read(path, contents[:place] + value + contents[place + 4 :])


def test_other_files_are_refused(sound, tmp_path):
    path, _ = sound
    rng = np.random.default_rng(0)
    for contents in (
        b"",
        b"\0",
        b"hello",
        b"\x1f\x8b" + bytes(40),
        b"PK\x03\x04" + bytes(40),
        rng.bytes(5001),
    ):
        if path.suffix == ".splat" and not contents:
            continue  # no rows are no Gaussians
        assert refused_or_read(path, contents) is None


def test_formats_that_can_only_be_read_say_so(tmp_path):
    with pytest.raises(FormatError, match=r"can only be read: splatax writes .*spz"):
        sx.save(tmp_path / "scene.ksplat", scene(n=2))
