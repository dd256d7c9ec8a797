"""Pages for this machine only."""

import urllib.error
import urllib.request

import pytest

from echelon_flight import FlightError, page_server
from echelon_flight.page_server import Handler


class Page(Handler):
    page = b"<html>"


def answer(address, **headers):
    request = urllib.request.Request(address, headers=headers)
    try:
        with urllib.request.urlopen(request, timeout=10) as got:
            return got.status, got.read()
    except urllib.error.HTTPError as error:
        return error.code, error.read()


def test_only_pages_of_this_server_are_answered_and_a_port_in_use_is_left(monkeypatch):
    with Page.serving(0) as address:
        own = address.rstrip("/")
        port = int(own.rpartition(":")[2])
        with Page.serving(port) as other:
            assert other != address
        assert answer(address) == (200, b"<html>")
        assert answer(address, Origin=own)[0] == 200
        assert answer(address, Origin="http://example.org")[0] == 403
        assert answer(address, Host="example.org")[0] == 403
        assert answer(address, Host=f"example.org:{port}")[0] == 403
        assert answer(address + "else")[0] == 404
        monkeypatch.setattr(page_server, "_TRIES", 1)
        with pytest.raises(FlightError, match=r"^ports \d+ to \d+ are in use; give another"):
            with Page.serving(port):
                pass


def test_other_machines_need_the_word_in_the_address():
    with Page.serving_others() as address:
        port, word = address.rstrip("/").rpartition(":")[2].split("/")
        near = f"http://127.0.0.1:{port}"
        assert answer(f"{near}/{word}/") == (200, b"<html>")
        assert answer(f"{near}/{word}/", Origin=near)[0] == 200
        assert answer(f"{near}/{word}/", Origin="http://example.org")[0] == 403
        for path in ("/", "/index.html", f"/{word}", f"/{word}x/", f"/{word[:-1]}/", "//"):
            assert answer(near + path)[0] == 403
    with Page.serving_others() as other:
        assert word not in other and len(word) >= 12
