"""The doctor sees what is there, and what is wrong with it."""

from dataclasses import replace

import jax
import pytest

from splatax import cli, rasterizers
from splatax.rasterizers import xla


def test_every_rasterizer_is_listed_with_its_state(capsys):
    cli.main(["doctor"])
    printed = capsys.readouterr().out
    assert all(name in printed for name in rasterizers.BACKENDS)
    assert printed.count("chosen by auto") == 1
    assert "WRONG" not in printed


def test_a_wrong_rasterizer_is_found_out(capsys, monkeypatch):
    right = xla.composite

    def wrong(splats, channels):
        return right(replace(splats, opacities=splats.opacities * 0.999), channels)

    monkeypatch.setattr(xla, "composite", wrong)
    jax.clear_caches()
    with pytest.raises(SystemExit) as exit:
        cli.main(["doctor"])
    jax.clear_caches()
    assert exit.value.code == 1
    assert "WRONG" in capsys.readouterr().out
