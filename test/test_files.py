# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What nobody else can have written is believed, and nothing else; no link is followed."""

import os
import stat

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fdi_ros.system import files

STRANGER = 54321
as_root = pytest.mark.skipif(
    os.geteuid() != 0, reason="only root can give a file to another user"
)


@given(mode=st.integers(0, 0o777), folder=st.booleans())
def test_what_others_can_write_is_refused_and_nothing_else(
    tmp_path_factory, mode, folder
):
    path = tmp_path_factory.mktemp("modes") / "one"
    path.mkdir() if folder else path.write_text("x")
    path.chmod(mode)
    if mode & 0o022:
        with pytest.raises(files.DistrustError, match="others can write it"):
            files.check_trusted(path)
    else:
        files.check_trusted(path)
    if folder:
        files.close_to_others(path)
        assert stat.S_IMODE(path.stat().st_mode) == mode & ~0o022


@as_root
def test_what_belongs_to_another_user_is_refused(tmp_path):
    path = tmp_path / "one"
    path.write_text("x")
    files.check_trusted(path)
    assert files.read_trusted(path, 10) == b"x"
    os.chown(path, STRANGER, 0)
    for refuse in (
        files.check_trusted,
        files.close_to_others,
        lambda path: files.read_trusted(path, 10),
    ):
        with pytest.raises(files.DistrustError, match=f"another user .{STRANGER}"):
            refuse(path)


def test_links_and_pipes_are_neither_followed_nor_waited_for(tmp_path):
    target, link, pipe = tmp_path / "target", tmp_path / "link", tmp_path / "pipe"
    target.write_text("x")
    link.symlink_to(target)
    os.mkfifo(pipe)
    for refuse in (
        files.check_trusted,
        files.close_to_others,
        lambda path: files.read_trusted(path, 10),
    ):
        with pytest.raises(files.DistrustError, match="it is a link"):
            refuse(link)
    with files.open_regular(link) as file:
        assert file.read() == b"x"
    for links in (True, False):
        with pytest.raises(files.DistrustError, match="no regular file"):
            files.open_regular(pipe, links)
    with files.replacing(link) as file:
        file.write(b"new")
    assert (target.read_text(), link.read_text(), link.is_symlink()) == (
        "x",
        "new",
        False,
    )


@pytest.mark.parametrize("mask", [0o000, 0o002, 0o077])
def test_what_is_written_is_closed_to_others_whatever_the_umask_and_gone_if_it_fails(
    tmp_path, mask
):
    path, before = tmp_path / "one", os.umask(mask)
    try:
        with files.replacing(path) as file:
            file.write(b"first")
        with pytest.raises(TypeError), files.replacing(path) as file:
            file.write("no bytes")
    finally:
        os.umask(before)
    files.check_trusted(path)
    assert path.read_bytes() == b"first"
    assert list(tmp_path.iterdir()) == [path]


def test_a_folder_in_which_everybody_can_swap_ours_is_refused(tmp_path):
    files.check_ancestor(tmp_path)
    tmp_path.chmod(0o1777)
    files.check_ancestor(tmp_path)
    tmp_path.chmod(0o777)
    with pytest.raises(files.DistrustError, match="everybody can write it"):
        files.check_ancestor(tmp_path)
