"""`splatax doctor` lists all backends, and finds a wrong one."""

from dataclasses import replace

import pytest

from splatax import backends, cli
from splatax.backends import portable


@pytest.mark.slow
def test_every_rasterizer_is_listed_with_its_state(capsys):
    cli.main(["doctor"])
    printed = capsys.readouterr().out
    assert all(name in printed for name in backends.BACKENDS)
    assert printed.count("chosen by auto") == 1
    assert "WRONG" not in printed


@pytest.mark.slow
def test_a_wrong_rasterizer_is_found_out(capsys, monkeypatch):
    right = portable.KERNELS.composite

    def wrong(splats, channels):
        return right(replace(splats, opacities=splats.opacities * 0.999), channels)

    monkeypatch.setattr(portable, "KERNELS", replace(portable.KERNELS, composite=wrong))
    with pytest.raises(SystemExit) as exit:
        cli.main(["doctor"])
    assert exit.value.code == 1
    assert "WRONG" in capsys.readouterr().out
