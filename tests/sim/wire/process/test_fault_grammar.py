"""Notation of faults, and messages on mistakes in it."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rigd.sim.wire import WrongUseError, parse_fault

whole = st.integers
sender = st.sampled_from(["drive", "sensor", "host"])
device = st.sampled_from(["drive", "sensor"])
positive = st.floats(1e-6, 1e6)
identifier = whole(0, 0x7FF)
frames = whole(1, 10**9)


def text(numbers):
    """Numbers as they are written."""
    return numbers.map(repr)


OPTIONAL = {
    "drop": ({"from": sender}, {"id": identifier, "frames": frames}),
    "delay": ({"from": sender, "ms": positive}, {"id": identifier, "frames": frames}),
    "corrupt": ({"from": sender}, {"id": identifier, "frames": frames, "byte": whole(0, 255)}),
    "reorder": ({"from": sender}, {"id": identifier, "frames": frames}),
    "freeze": ({"device": device}, {"for": positive}),
    "emcy": ({"code": whole(0, 0xFFFF)}, {"register": whole(0, 255)}),
    "sto": ({}, {"for": positive}),
    "busoff": ({}, {"for": positive}),
    "saturate": ({"gauge": whole(0, 5)}, {"for": positive}),
    "status": ({"bits": whole(0, 0xFFFF)}, {"for": positive}),
    "stuck": (
        {"what": st.sampled_from(["encoder", "sensor", "gauge"])},
        {"gauge": whole(0, 5), "every": whole(2, 1000), "for": positive},
    ),
    "jump": ({"counts": whole(-(2**31), 2**31 - 1)}, {}),
    "cut": ({}, {"device": st.sampled_from(["bus", "sensor"])}),
    "restart": ({"device": device}, {}),
    "power_cycle": ({"device": device}, {}),
    "lag": ({"ms": positive}, {"for": positive}),
    "no_pre_operational": ({}, {"for": positive}),
    "no_bit_12": ({}, {"for": positive}),
    "no_watch": ({}, {"for": positive}),
    "object": (
        {"index": whole(0x1000, 0xFFFF)},
        {"sub": whole(0, 255), "value": whole(0, 2**32 - 1)},
    ),
    "obstacle": (
        {"x": text(st.floats(1e-3, 100)), "angle": text(st.floats(-10, 10))},
        {
            "stiffness": text(st.floats(1, 1e7)) | st.just("rigid"),
            "damping": text(st.floats(0, 1e4)),
            "side": st.sampled_from(["1", "-1"]),
            "rate": text(st.floats(-100, 100)),
            "for": positive,
        },
    ),
    "knock": (
        {
            "x": text(st.floats(1e-3, 100)),
            "force": text(st.floats(-1e3, 1e3)),
            "duration": text(st.floats(1e-4, 100)),
        },
        {},
    ),
    "end": ({}, {"fault": st.sampled_from(["sto", "freeze", "cut", "drop"])}),
}
faults = st.one_of(
    *(
        st.tuples(
            st.just(kind),
            st.fixed_dictionaries(needed, optional=optional),
            st.none() | st.floats(0, 1e6),
        )
        for kind, (needed, optional) in OPTIONAL.items()
    )
)


def test_every_kind_is_tested():
    with pytest.raises(WrongUseError) as refused:
        parse_fault("none")
    known = str(refused.value).partition("choose ")[2].rstrip(".")
    assert OPTIONAL.keys() == set(known.split(", "))


@settings(max_examples=200)
@given(faults, st.randoms())
def test_faults_are_read_and_written_back(question, random):
    kind, values, after_s = question
    words = [
        f"{key}={value!r}" if isinstance(value, float) else f"{key}={value}"
        for key, value in values.items()
    ]
    random.shuffle(words)
    spec = ",".join([kind, *words]) + ("" if after_s is None else f"@{after_s!r}")
    fault = parse_fault(spec)
    assert fault.kind == kind
    assert fault.after_s == after_s
    assert dict(fault.values) | values == dict(fault.values)
    again = parse_fault(str(fault))
    assert (again.kind, dict(again.values), again.after_s) == (kind, dict(fault.values), after_s)


@settings(max_examples=50)
@given(st.text(max_size=40) | st.text(alphabet="dropfmes=,@0x1.-", max_size=20))
def test_other_text_is_refused_with_a_sentence(text):
    try:
        fault = parse_fault(text)
    except WrongUseError as error:
        assert str(error).startswith(f"Fault '{text}': ")
        assert str(error).endswith(".")
    else:
        assert fault.kind in OPTIONAL


@pytest.mark.parametrize(
    ("spec", "message"),
    [
        ("dorp,from=drive", "unknown fault 'dorp'; choose drop, delay, corrupt, reorder, freeze"),
        ("drop", "drop needs from: drive or sensor or host"),
        ("drop,from=cat", "from=cat: give drive or sensor or host"),
        ("drop,from=drive,colour=red", "drop has no 'colour'; choose from, id, frames, bytes"),
        ("drop,from=drive,frames=0", "frames=0: give a whole number from 1"),
        ("drop,from=drive,id=0x800", "id=0x800: give a whole number from 0 to 2047"),
        ("drop,from=drive,from=host", "'from' is given twice"),
        ("drop,from=sensor,frames=2,bytes=3", "give frames or bytes, not both"),
        ("delay,from=drive", "delay needs ms: a number above 0"),
        ("delay,from=drive,ms=nan", "ms=nan: give a number above 0"),
        ("saturate,gauge=6", "gauge=6: give a whole number from 0 to 5"),
        ("emcy", "emcy needs code"),
        ("cut@soon", "'@soon': give the seconds after enabling"),
        ("cut@-1", "'@-1': give the seconds after enabling"),
        ("cut@", "'@': give the seconds after enabling"),
    ],
)
def test_the_wrong_word_is_named(spec, message):
    with pytest.raises(WrongUseError) as caught:
        parse_fault(spec)
    assert message in str(caught.value)


def test_defaults():
    assert dict(parse_fault("drop,from=drive").values) == {"from": "drive", "frames": 1}
    assert dict(parse_fault("drop,from=sensor,bytes=5").values) == {"from": "sensor", "bytes": 5}
    assert dict(parse_fault("emcy,code=0x8130").values) == {"code": 0x8130, "register": 1}
    assert dict(parse_fault("cut").values) == {"device": "bus"}
    assert parse_fault("cut@2.5").after_s == 2.5
