"""Modbus frames against the bytes in devices.md 2.1, and an implementation of the checksum here."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rigd.devices.ati import _serial_protocol as modbus


def hexed(text):
    return bytes.fromhex(text)


def test_requests_have_the_published_bytes():
    assert hexed("0A 46 55 A3 9D") == modbus.START_STREAMING
    assert hexed("0A 6A AA FF 1D") == modbus.UNLOCK
    assert hexed("0A 6A 18 7F 68") == modbus.LOCK
    assert modbus.read_registers(modbus.STATUS_WORD, 1) == hexed("0A 03 00 1D 00 01 15 77")
    assert modbus.read_registers(0x00E3, 0x40) == hexed("0A 03 00 E3 00 40 B4 B7")


def test_published_replies_are_understood():
    assert modbus.content_of(modbus.START_STREAMING, hexed("0A 46 01 A2 62")) == b"\x01"
    assert modbus.content_of(modbus.UNLOCK, hexed("0A 6A 01 BE A2")) == b"\x01"
    assert modbus.content_of(modbus.LOCK, hexed("0A 6A 01 BE A2")) == b"\x01"


def test_gains_and_offsets_are_written_in_twelve_bytes(fakes):
    body = hexed("0A 10 00 06 00 06 0C 7C 62 7D 00 80 00 80 E8 84 D0 88 6F")
    request = modbus.write_registers(
        modbus.ACTIVE_OFFSETS, (31842, 32000, 32768, 33000, 34000, 34927)
    )
    assert request == body + fakes.crc_bitwise(body)
    assert modbus.ACTIVE_GAINS == 0
    confirmed = body[:6] + fakes.crc_bitwise(body[:6])
    assert modbus.reply_length(request) == len(confirmed) == 8
    assert modbus.content_of(request, confirmed) == body[2:6]


def test_registers_are_read_high_byte_first(fakes):
    request = modbus.read_registers(0x1D, 2)
    reply = hexed("0A 03 04 12 34 FF FE")
    reply += fakes.crc_bitwise(reply)
    assert modbus.reply_length(request) == len(reply)
    assert modbus.registers_of(modbus.content_of(request, reply)) == (0x1234, 0xFFFE)


@settings(max_examples=100)
@given(data=st.binary(max_size=80))
def test_the_checksum_is_that_of_modbus(fakes, data):
    assert modbus.crc16(data).to_bytes(2, "little") == fakes.crc_bitwise(data)


def test_the_checksum_of_the_standard_example():
    assert modbus.crc16(b"123456789") == 0x4B37


def reply_to_status(fakes, body):
    return modbus.content_of(
        modbus.read_registers(modbus.STATUS_WORD, 1), body + fakes.crc_bitwise(body)
    )


@pytest.mark.parametrize(
    ("code", "words"), [(1, "function"), (2, "no such register"), (4, "failed"), (99, "code 99")]
)
def test_a_refusal_is_told_in_words(fakes, code, words):
    with pytest.raises(modbus.Refused, match=words):
        reply_to_status(fakes, bytes((0x0A, 0x83, code)))


def test_a_declined_start_and_lock_are_refusals(fakes):
    for request in (modbus.START_STREAMING, modbus.UNLOCK):
        body = request[:2] + b"\x00"
        with pytest.raises(modbus.Refused, match="code 0"):
            modbus.content_of(request, body + fakes.crc_bitwise(body))


@pytest.mark.parametrize(
    ("body", "words"),
    [
        ("0B 03 02 00 00", "another request"),
        ("0A 04 02 00 00", "another request"),
        ("0A 03 03 00 00", "3 bytes of registers"),
        ("0A 03 02 00", "6 bytes came instead of 7"),
        ("0A 03 04 00 00 00 00", "9 bytes came instead of 7"),
    ],
)
def test_replies_that_do_not_fit_the_request(fakes, body, words):
    with pytest.raises(modbus.BadReply, match=words):
        reply_to_status(fakes, hexed(body))


def test_confirmation_of_other_registers(fakes):
    request = modbus.write_registers(0, (1, 2))
    body = hexed("0A 10 00 00 00 03")
    with pytest.raises(modbus.BadReply, match="other registers"):
        modbus.content_of(request, body + fakes.crc_bitwise(body))


def test_silence_is_a_bad_reply():
    with pytest.raises(modbus.BadReply, match="no reply"):
        modbus.content_of(modbus.UNLOCK, b"")


@settings(max_examples=200)
@given(
    at=st.integers(0, 6),
    mask=st.integers(1, 255),
    cut=st.integers(0, 7),
    extra=st.binary(max_size=3),
)
def test_a_damaged_reply_is_never_taken(fakes, at, mask, cut, extra):
    body = hexed("0A 03 02 5A A5")
    sound = body + fakes.crc_bitwise(body)
    damaged = bytearray(sound)
    damaged[at] ^= mask
    request = modbus.read_registers(modbus.STATUS_WORD, 1)
    for reply in (bytes(damaged), sound[:cut] + extra):
        if reply != sound:
            with pytest.raises(modbus.BadReply):
                modbus.content_of(request, reply)
