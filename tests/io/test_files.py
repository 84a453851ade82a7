"""Files that are written whole or not at all."""

import pytest

from splatax.io.files import replacing, write_whole


def stop(file):
    file.write(b"half")
    raise RuntimeError("stop")


def test_a_failure_leaves_the_old_file_and_no_other(tmp_path):
    path = tmp_path / "scene.ply"
    write_whole(path, b"old")
    with pytest.raises(RuntimeError, match="stop"), replacing(path) as file:
        stop(file)
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("parent", ["nowhere", "file"])
def test_what_cannot_be_written_is_named_as_the_caller_named_it(tmp_path, parent):
    (tmp_path / "file").touch()
    path = tmp_path / parent / "scene.ply"
    with pytest.raises(OSError, match="scene") as refused:
        write_whole(path, b"")
    assert refused.value.filename == str(path)
