"""`splatax train --hosts`: processes that run the same command train one scene, and one of them writes it."""

import socket
import subprocess
import sys

import pytest
from test_refusals import refused

from emitters import as_users_compile
from splatax import backends

needs_cpu = pytest.mark.skipif(
    backends.why_unavailable("cpu") is not None, reason="only the native backend computes each row alone"
)


def command(capture, out, *options):
    sizes = ("--steps", "4", "--views", "2", "--max-gaussians", "300", "--eval-every", "2")
    return [sys.executable, "-m", "splatax", "train", str(capture), "--out", str(out), *sizes, *options]


@needs_cpu
@pytest.mark.slow
def test_two_processes_write_the_scene_of_one_and_only_process_0_writes(capture, tmp_path):
    alone = tmp_path / "alone"
    subprocess.run(command(capture, alone), check=True, capture_output=True, env=as_users_compile())
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    outs = [tmp_path / "both", tmp_path / "other"]
    processes = [
        subprocess.Popen(
            command(capture, out, "--hosts", f"127.0.0.1:{port},2,{index}", "--checkpoint-steps", "2"),
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env=as_users_compile(),
        )
        for index, out in enumerate(outs)
    ]
    printed = [process.communicate(timeout=300) for process in processes]
    assert [process.returncode for process in processes] == [0, 0], printed
    assert (outs[0] / "scene.ply").read_bytes() == (alone / "scene.ply").read_bytes()
    assert not outs[1].exists()
    assert "test PSNR" in printed[0][0]
    assert not any(word in printed[1][0] for word in ("photos", "PSNR", "report"))


def test_hosts_that_make_no_sense_are_refused(capsys, capture):
    assert "ADDRESS:PORT,COUNT,INDEX" in refused(capsys, "train", capture, "--hosts", "10.0.0.1,2")


def test_several_photos_a_step_need_a_number_of_steps(capsys, capture):
    assert "--steps" in refused(capsys, "train", capture, "--views", "4")
