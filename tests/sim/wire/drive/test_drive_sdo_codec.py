"""The SDO server against a client written here from CiA 301."""

import struct

from hypothesis import given, settings
from hypothesis import strategies as st

from rigd.sim.wire._object_dictionary import Abort, AbortCode, Entry, ObjectDictionary, SdoServer

MODEST = settings(max_examples=150)
LETTERS = "bBhHiI"


class Client:
    def __init__(self, objects):
        self.replies = []
        self.wrote = []
        self.server = SdoServer(objects, self.replies.append, lambda *what: self.wrote.append(what))

    def ask(self, request):
        self.server.receive(bytes(request))
        return self.replies.pop()

    def upload(self, index, sub):
        reply = self.ask(struct.pack("<BHBI", 0x40, index, sub, 0))
        if reply[0] == 0x80:
            return struct.unpack("<I", reply[4:])[0]
        assert reply[1:4] == struct.pack("<HB", index, sub)
        if reply[0] & 2:
            assert reply[0] & 1
            return reply[4 : 8 - (reply[0] >> 2 & 3)]
        assert reply[0] == 0x41
        value, toggle = b"", 0
        while True:
            segment = self.ask(bytes([0x60 | toggle]) + bytes(7))
            assert segment[0] & 0xF0 == toggle
            value += segment[1 : 8 - (segment[0] >> 1 & 7)]
            if segment[0] & 1:
                break
            toggle ^= 0x10
        assert len(value) == struct.unpack("<I", reply[4:])[0]
        return value

    def download(self, index, sub, value, sizes, *, announce=True):
        """In segments of these sizes."""
        length = struct.pack("<I", len(value)) if announce else bytes(4)
        reply = self.ask(struct.pack("<BHB", 0x20 | announce, index, sub) + length)
        toggle = 0
        while reply[0] != 0x80:
            size = sizes.pop(0)
            part, value = value[:size], value[size:]
            command = toggle | (7 - size) << 1 | (not value)
            reply = self.ask(bytes([command]) + part.ljust(7, b"\xee"))
            assert reply[0] in (0x80, 0x20 | toggle)
            if not value and reply[0] != 0x80:
                return 0
            toggle ^= 0x10
        return struct.unpack("<I", reply[4:])[0]


def dictionary(*entries):
    objects = ObjectDictionary()
    for index, one in enumerate(entries, 0x2000):
        objects.add(index, one)
    return objects


def cut(data, length):
    """Sizes of 1 to 7 that add up to a length."""
    sizes = []
    while length:
        sizes.append(data.draw(st.integers(1, min(7, length))))
        length -= sizes[-1]
    return sizes


@MODEST
@given(text=st.binary(min_size=1, max_size=60))
def test_a_text_of_any_length_is_uploaded(text):
    client = Client(dictionary(Entry("s", access="ro", text=text)))
    assert client.upload(0x2000, 0) == text
    assert client.upload(0x2000, 0) == text
    assert client.wrote == []


@MODEST
@given(letter=st.sampled_from(LETTERS), announce=st.booleans(), data=st.data())
def test_a_number_comes_back_as_it_was_written(letter, announce, data):
    size = struct.calcsize("<" + letter)
    raw = data.draw(st.binary(min_size=size, max_size=size))
    objects = dictionary(Entry(letter))
    client = Client(objects)
    if data.draw(st.booleans()):
        assert client.download(0x2000, 0, raw, cut(data, size), announce=announce) == 0
    else:
        head = 0x23 | (4 - size) << 2 if announce else 0x22
        reply = client.ask(struct.pack("<BHB", head, 0x2000, 0) + raw.ljust(4, b"\0"))
        assert reply == struct.pack("<BHBI", 0x60, 0x2000, 0, 0)
    assert client.upload(0x2000, 0) == raw
    assert client.wrote == [(0x2000, 0, struct.unpack("<" + letter, raw)[0])]


@MODEST
@given(
    letter=st.sampled_from(LETTERS),
    raw=st.binary(min_size=1, max_size=12),
    announce=st.booleans(),
    data=st.data(),
)
def test_another_length_is_refused_and_changes_nothing(letter, raw, announce, data):
    if len(raw) == struct.calcsize("<" + letter):
        raw += b"\0"
    client = Client(dictionary(Entry(letter, 7)))
    sizes = cut(data, len(raw))
    assert client.download(0x2000, 0, raw, sizes, announce=announce) == 0x06070010
    assert client.wrote == []
    assert client.upload(0x2000, 0)[0] == 7


@MODEST
@given(
    letter=st.sampled_from(LETTERS),
    bounds=st.lists(st.integers(-100, 100), min_size=2, max_size=2).map(sorted),
    value=st.integers(-128, 127),
)
def test_a_range_is_kept(letter, bounds, value):
    low, high = bounds
    one = Entry(letter, 0, low=low, high=high)
    raw = struct.pack("<" + letter.lower(), value)
    number = struct.unpack("<" + letter, raw)[0]
    code = Client(dictionary(one)).download(0x2000, 0, raw, [len(raw)])
    assert code == (0 if low <= number <= high else 0x06090030)
    assert one.value == (number if low <= number <= high else 0)


def test_access_rights():
    objects = dictionary(Entry("B", 5, "ro"), Entry("B", 5, "wo"))
    client = Client(objects)
    assert client.download(0x2000, 0, b"\1", [1]) == 0x06010002
    assert client.upload(0x2001, 0) == 0x06010001
    assert client.download(0x2001, 0, b"\1", [1]) == 0
    assert client.upload(0x2002, 0) == 0x06020000
    assert client.upload(0x2000, 1) == 0x06090011


def test_what_a_check_refuses_is_not_stored():
    def check(value):
        raise Abort(AbortCode.STATE)

    one = Entry("B", 5, check=check)
    assert Client(dictionary(one)).download(0x2000, 0, b"\1", [1]) == 0x08000022
    assert one.value == 5


def test_a_new_transfer_takes_the_place_of_one_that_has_not_ended():
    client = Client(dictionary(Entry("I", 1), Entry("s", text=b"0123456789")))
    client.ask(bytes.fromhex("20 00 20 00 00 00 00 00"))
    client.ask(bytes.fromhex("0a aa aa 00 00 00 00 00"))
    assert client.upload(0x2001, 0) == b"0123456789"
    assert client.upload(0x2000, 0) == b"\1\0\0\0"
    assert client.download(0x2000, 0, b"\2\0\0\0", [4]) == 0
