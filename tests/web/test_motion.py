"""Pages that play a clip: the numbers that they hold, and the images in a browser."""

import base64
from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
from screenshots import picture, psnr

import splatax as sx
from scenes import random_gaussians
from splatax import web
from splatax.demo.rigged import camera_around, drawn_arm
from splatax.scene.binding import covering
from splatax.scene.rigged import AnimatedScene, RiggedScene
from splatax.transforms import Similarity
from splatax.web.skinned import TO_VIEWER, packed

SIZE = 240
TIMES = (0.0, 0.25, 0.5, 0.9, 1.5)  # seconds
LIKE = 32.0  # dB
FIELDS = ("means", "quats", "log_scales", "opacity_logits", "sh")


def scene() -> RiggedScene:
    body = drawn_arm()
    gaussians, rig = covering(body, 3000, opacity=0.9)
    stripes = np.sin(np.asarray(gaussians.means) * [9, 7, 8])
    gaussians = replace(gaussians, sh=jnp.asarray(1.2 * stripes[:, None], jnp.float32))
    return RiggedScene(gaussians, rig, body.clips)


def test_weights_of_eight_bits_sum_to_one_and_are_off_by_less_than_one_level():
    rng = np.random.default_rng(0)
    weights = np.concatenate([rng.dirichlet(np.full(4, 0.3), 500), [[1, 0, 0, 0], [0.5, 0.5, 0, 0]]])
    indices = np.stack([rng.permutation(200)[:4] for _ in weights])
    rows = packed(indices, weights)
    assert rows.dtype == np.dtype("<u2")
    assert ((rows & 255).sum(axis=1) == 255).all()
    found = np.zeros((len(weights), 256))
    np.add.at(found, (np.arange(len(weights))[:, None], rows >> 8), rows & 255)
    np.add.at(found, (np.arange(len(weights))[:, None], indices), -255 * weights)
    assert np.abs(found).max() < 1


def test_bones_move_the_splats_of_the_viewer_as_the_skin_moves_those_of_the_world():
    rigged = scene()
    place = Similarity.of(degrees=(10.0, 20.0, 30.0), scale=2.0, move=(1.0, -2.0, 0.5))
    motion = web.Motion(rigged.rig, rigged.clips["Wave"])
    described = motion.described(place, np.arange(len(rigged.gaussians)), "page")
    bones = np.frombuffer(base64.b64decode(described["bones"]), "<f4").reshape(-1, described["joints"], 12)
    assert len(bones) == 121  # 2 seconds
    skin = np.frombuffer(base64.b64decode(described["skin"]), "<u2").reshape(-1, 4)
    frame = 15
    columns = np.einsum("nk,nkc->nc", (skin & 255) / 255, bones[frame][skin >> 8]).reshape(-1, 4, 3)
    before = np.asarray(place.transform(rigged.gaussians).means) @ TO_VIEWER[:3, :3]
    moved = np.einsum("ni,nij->nj", before, columns[:, :3]) + columns[:, 3]
    after = place.transform(rigged.at("Wave", frame / 60)).means @ TO_VIEWER[:3, :3].astype(np.float32)
    np.testing.assert_allclose(moved, after, atol=0.02)  # levels of the weights


@pytest.mark.slow
def test_a_page_shows_what_our_renderer_draws_at_all_times_of_the_clip(open_page, tmp_path, viewer):
    rigged, body = scene(), drawn_arm()
    camera = camera_around(body, 0.3, 0.2, SIZE)
    web.save(
        tmp_path / "wave.html",
        rigged.gaussians,
        title="wave",
        cameras={"view": camera},
        background=(1.0, 1.0, 1.0),
        motion=web.Motion(rigged.rig, rigged.clips["Wave"]),
        lod_above=100,  # not for splats that bones move, whose indices it would change
    )
    tab = open_page(tmp_path / "wave.html", (SIZE, SIZE))  # asks for reduced motion, so the clip is paused
    tab.settle()
    scores = []
    for time in TIMES:
        tab.tell(f"(viewer.settled = false, viewer.stage.animation.show({time}))")
        tab.settle()
        drawn = sx.render(rigged.at("Wave", time), camera, background=sx.WHITE).rgb
        scores.append(psnr(picture(tab), np.clip(drawn, 0, 1)))
    print("dB at each time:", [round(score, 1) for score in scores])
    assert min(scores) > LIKE
    assert tab.errors == []
    tab.tell("viewer.animate()")
    tab.wait_for(f"viewer.stage.animation.time !== {TIMES[-1]}")


def test_motions_that_do_not_fit_the_scene_are_refused(viewer):
    rigged = scene()
    motion = web.Motion(rigged.rig, rigged.clips["Wave"])
    parts = sx.Scene({"arm": sx.Part(rigged.gaussians)})

    def document(scene, motion):
        web.document(scene, title="arm", motion=motion, name="arm.html")

    with pytest.raises(sx.FormatError, match=r"arm\.html: a motion moves part 'leg', but the scene has arm"):
        document(parts, {"leg": motion})
    with pytest.raises(sx.FormatError, match="by the names of its parts"):
        document(parts, motion)
    fewer = replace(rigged.gaussians, **{name: getattr(rigged.gaussians, name)[:9] for name in FIELDS})
    with pytest.raises(sx.FormatError, match="part 'scene' has 9 Gaussians, and its rig 3,000"):
        document(fewer, motion)


@pytest.mark.slow
def test_a_part_moves_beside_another_that_stays_as_our_renderer_draws_them(open_page, tmp_path, viewer):
    rigged, body = scene(), drawn_arm()
    camera = camera_around(body, 0.3, 0.2, SIZE)
    place = Similarity.of(degrees=(0.0, 40.0, 15.0), scale=0.6, move=(0.3, -0.5, 0.2))
    wheel = random_gaussians(1, n=800, degree=0, scale=(0.02, 0.08), spread=0.5)
    parts = sx.Scene({"wheel": sx.Part(wheel), "arm": sx.Part(rigged.gaussians, place)})
    clip = rigged.clips["Wave"]
    web.save(
        tmp_path / "wave.html",
        parts,
        title="wave",
        cameras={"view": camera},
        background=(1.0, 1.0, 1.0),
        motion={"arm": web.Motion(rigged.rig, clip)},
    )
    tab = open_page(tmp_path / "wave.html", (SIZE, SIZE))
    tab.settle()
    scores = []
    for time in TIMES:
        tab.tell(f"(viewer.settled = false, viewer.stage.animation.show({time}))")
        tab.settle()
        moved = AnimatedScene(parts, {"arm": rigged.rig}, {"Wave": clip}).at("Wave", time)
        drawn = sx.render(moved, camera, background=sx.WHITE).rgb
        scores.append(psnr(picture(tab), np.clip(drawn, 0, 1)))
    print("dB at each time:", [round(score, 1) for score in scores])
    assert min(scores) > LIKE
    assert tab.errors == []
