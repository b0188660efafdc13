# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Links on real sockets and a real terminal: never waiting, opened again, and no more waits to be sent than is said."""

import os
import pty
import socket
import time
import tty
from collections.abc import Callable

import pytest

from fdi_ros.errors import FdiError
from fdi_ros.mavlink.link import (
    MOST_AT_ONCE,
    MOST_WAITING,
    REOPEN_EVERY,
    Link,
    open_link,
)
from mavlink.autopilots import NS, free_port


class Clock:
    """Time in which a link may try again at once."""

    def __init__(self, link: Link) -> None:
        self.link, self.now = link, NS

    def read(self, until: Callable[[bytes], bool] = bool) -> bytes:
        data = b""
        for _ in range(500):
            self.now += REOPEN_EVERY
            data += b"".join(received for _, received in self.link.receive(self.now))
            if until(data):
                break
            self.link.wait(0.02)
        return data


def until(condition: Callable[[], object]) -> bool:
    for _ in range(500):
        if condition():
            return True
        time.sleep(0.01)
    return False


def test_udp_listens_and_answers_to_where_it_came_from() -> None:
    port = free_port()
    link = open_link(f"udpin:127.0.0.1:{port}")
    clock = Clock(link)
    assert clock.read(lambda _: not link.trouble) == b""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one:
        one.sendto(b"hello", ("127.0.0.1", port))
        link.wait(5.0)
        ((peer, received),) = link.receive(clock.now)
        assert received == b"hello"
        link.send(b"answer", peer)
        one.settimeout(5.0)
        assert one.recv(100) == b"answer"
    # To nobody, and to one who is gone, nothing happens.
    link.send(b"x", None)
    for _ in range(5):
        link.send(b"x", peer)
        assert link.receive(clock.now) == []
    assert not link.trouble
    # A second program on the same port is told so, and tries again.
    other = open_link(f"udpin:127.0.0.1:{port}")
    assert other.receive(NS) == []
    assert "in use" in other.trouble
    link.close()
    assert Clock(other).read(lambda _: not other.trouble) == b""
    assert not other.trouble
    other.close()


def test_udp_to_an_address() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one:
        one.bind(("127.0.0.1", 0))
        link = open_link(f"udpout:127.0.0.1:{one.getsockname()[1]}")
        clock = Clock(link)
        clock.read(lambda _: not link.trouble)
        link.send(b"first", None)
        data, peer = one.recvfrom(100)
        assert data == b"first"
        one.sendto(b"back", peer)
        assert clock.read() == b"back"
    # Nobody listens there any more.
    for _ in range(10):
        link.send(b"x", None)
        link.receive(clock.now)
    assert not link.trouble
    link.close()


def test_no_turn_takes_more_than_its_share() -> None:
    port = free_port()
    link = open_link(f"udpin:127.0.0.1:{port}")
    link.receive(NS)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one:
        for _ in range(200):
            one.sendto(bytes(2000), ("127.0.0.1", port))
        assert until(lambda: len(link.receive(NS)) <= MOST_AT_ONCE // 2000 + 1)
    link.close()


def test_tcp_is_connected_again_when_it_is_lost() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
        link = open_link(f"tcp:127.0.0.1:{port}")
        clock = Clock(link)
        for opened in (1, 2):
            clock.read(lambda _: not link.trouble)
            assert link.opened == opened
            peer, _ = server.accept()
            with peer:
                peer.sendall(b"one")
                assert clock.read(lambda data: len(data) == 3) == b"one"
                link.send(b"two", None)
                assert peer.recv(100) == b"two"
            clock.now -= REOPEN_EVERY * 100  # No attempt is due.
            assert until(lambda: link.receive(clock.now) == [] and link.trouble)
            clock.now += REOPEN_EVERY * 101
            assert "closed" in link.trouble
    link.close()
    nobody = open_link(f"tcp:127.0.0.1:{port}")
    assert Clock(nobody).read(lambda _: "refused" in nobody.trouble.lower()) == b""
    nobody.send(b"x", None)
    nobody.close()


def test_what_a_stream_does_not_take_is_dropped_whole() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        link = open_link(f"tcp:127.0.0.1:{server.getsockname()[1]}")
        Clock(link).read(lambda _: not link.trouble)
        peer, _ = server.accept()
        message = bytes(range(100))
        sent = 0
        while link.dropped < 100:
            before = link.dropped
            link.send(message, None)
            sent += link.dropped == before
        assert len(link._waiting) <= MOST_WAITING
        with peer:
            got = bytearray()
            peer.settimeout(5.0)
            while len(got) < sent * len(message):
                link.receive(NS)
                got += peer.recv(1 << 16)
        assert got == message * sent
    link.close()


def test_a_new_connection_begins_with_a_whole_message() -> None:
    """The rest of a message that the last connection did not take belongs to nobody."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        link = open_link(f"tcp:127.0.0.1:{server.getsockname()[1]}")
        clock = Clock(link)
        clock.read(lambda _: not link.trouble)
        peer, _ = server.accept()
        while not link.dropped:
            link.send(bytes(100), None)
        peer.close()
        clock.read(lambda _: bool(link.trouble))
        clock.read(lambda _: not link.trouble)
        peer, _ = server.accept()
        with peer:
            link.send(b"whole", None)
            peer.settimeout(5.0)
            assert peer.recv(100) == b"whole"
    link.close()


def test_a_serial_line_that_is_pulled_out_is_opened_again(tmp_path) -> None:
    pytest.importorskip("serial", reason="serial lines need pyserial")
    name = tmp_path / "autopilot"
    link = open_link(f"serial:{name}:115200")
    clock = Clock(link)
    assert link.receive(NS) == []
    assert "No such file" in link.trouble
    for opened in (1, 2):
        master, slave = pty.openpty()
        tty.setraw(slave)
        name.symlink_to(os.ttyname(slave))
        clock.read(lambda _: not link.trouble)
        os.close(slave)
        assert link.opened == opened
        os.write(master, b"hello")
        assert clock.read() == b"hello"
        link.send(b"there", None)
        assert os.read(master, 100) == b"there"
        name.unlink()
        os.close(master)
        assert clock.read(lambda _: bool(link.trouble)) == b""
    link.close()


@pytest.mark.parametrize(
    ("url", "words"),
    [
        ("", "expected udpin"),
        ("udp:1.2.3.4:5", "expected udpin"),
        ("udpin:127.0.0.1", "expected udpin"),
        ("udpin:127.0.0.1:70000", "expected udpin"),
        ("tcp:127.0.0.1:0", "expected udpin"),
        ("serial:/dev/ttyACM0", "expected udpin"),
        ("serial::115200", "expected udpin"),
        ("tcp:no such host:5760", "no address of"),
    ],
)
def test_a_url_that_is_none_is_refused(url: str, words: str) -> None:
    with pytest.raises(FdiError, match=words):
        open_link(url)
