"""A server of the page alone: canned messages of the contract, no daemon and no rig behind it."""

import asyncio
import math
import threading
from contextlib import contextmanager
from pathlib import Path

from aiohttp import web

import rigd
from rigd.units import UNITS

STATIC = Path(rigd.__file__).parent / "web" / "static"
TOKEN = "right-to-act"
UTC_NS = 1_795_000_000_000_000_000

POLICY = "default-src 'self'"

EXCITATIONS = {
    "chirp": [
        {"name": "amplitude_rad", "unit": "rad", "default": 0.025, "help": "Amplitude."},
        {"name": "start_hz", "unit": "Hz", "default": 0.05, "help": "Frequency at the start."},
        {"name": "stop_hz", "unit": "Hz", "default": 50.0, "help": "Frequency at the end."},
        {"name": "duration_s", "unit": "s", "default": 120.0, "help": "Duration of the sweep."},
        {"name": "rest_s", "unit": "s", "default": 1.0, "help": "Rest before the excitation."},
        {"name": "ring_down_s", "unit": "s", "default": 15.0, "help": "Ring-down after it."},
        {"name": "taper_s", "unit": "s", "default": 0.0, "help": "Fade-in and fade-out time."},
    ],
    "hold": [{"name": "duration_s", "unit": "s", "default": 10.0, "help": "Duration."}],
    "file": [{"name": "path", "unit": "", "default": None, "help": "CSV file."}],
    "until": [
        {"name": "targets", "unit": "", "default": None, "help": "What is asked.", "text": True},
        {"name": "at_most_s", "unit": "s", "default": 120.0, "help": "Longest record."},
    ],
}


def hello(**members):
    return {
        "type": "hello", "profile": "sim", "limits": {}, "daemon": {}, "excitations": EXCITATIONS,
        "specimens": ["antenna 3", "antenna 4"], "required_meta": [],
        "units": dict(UNITS), **members,
    }  # fmt: skip


def status(state="ready", **members):
    return {
        "type": "status",
        "daemon": {
            "pid": 4711, "version": "0.1.0", "profile": "sim", "moving": "simulated",
            "hardware": False, "what_moves": "Nothing moves: the rig sim is simulated.",
            "output": "/data/sessions", "fast": False, "live": True, "since_utc_ns": UTC_NS,
            "calibration": {"serial": "FT12345", "age": "2026-08-20"},
        },
        "state": state, "since_utc_ns": UTC_NS, "reason": "the simulated rig is connected",
        "doing": "", "zero_lost": False,
        "controller": None, "series": None, "progress": None, "last_check": None,
        "rig": {
            "phase": "off", "angle_rad": 0.0, "coupling_torque_nm": 0.0, "torque_command_nm": 0.0,
            "signals": None, "live_view": None, "processes": [], "topics": [],
            "health": {
                "missed": 0, "late": 0, "lost": 0, "bus_load_percent": None, "bus_errors": None,
                "sensor_status": 0, "disk_free_mb": 48_211.0, "view_dropped": 0,
            },
        },
        "history": [
            {"utc_ns": UTC_NS, "from": "idle", "to": "ready",
             "reason": "the simulated rig is connected"},
        ],
        **members,
    }  # fmt: skip


def progress(fraction, total_s=136.0, **members):
    total = round(1000 * total_s)
    return {
        "type": "progress", "session": 1, "repeat": 1, "phase": "running",
        "tick": round(fraction * total), "total": total, "percent": 100 * fraction,
        "time_left_s": total_s * (1 - fraction), "missed": 0, "late": 3, "lost": 0, **members,
    }  # fmt: skip


def gauges(fraction=0.4, frequency_hz=12.3):
    limits = {
        "angle": (0.5, "rad"), "velocity": (10.0, "rad/s"), "tracking_error": (0.05, "rad"),
        "torque_command": (60.0, "N·m"), "i2t": (0.5, "N·m"),
        **dict.fromkeys(("fx", "fy", "fz"), (20.0, "N")),
        **dict.fromkeys(("tx", "ty", "tz"), (1.0, "N·m")),
    }  # fmt: skip
    fractions = [fraction * (0.35 + 0.65 * math.cos(k) ** 2) for k in range(len(limits))]
    fractions[0] = fraction
    return {
        "type": "gauges", "frequency_hz": frequency_hz,
        **{
            name: {"value": each * limit, "limit": limit, "unit": unit, "fraction": each}
            for (name, (limit, unit)), each in zip(limits.items(), fractions, strict=True)
        },
    }  # fmt: skip


def strip(t0_s, bins, amplitude_rad=0.025):
    """Envelopes of a chirp at its 20 bins a second."""
    times = [t0_s + 0.05 * k for k in range(bins)]
    fine = [
        [amplitude_rad * math.sin(2.0 * (t + 0.005 * j) ** 1.6) for j in range(10)] for t in times
    ]
    swing = [0.12 * math.sin(16.3 * t) + 0.03 * math.sin(3 * t) for t in times]
    return {
        "type": "strip", "t0_s": t0_s, "dt_s": 0.05,
        "angle_min": [min(f) for f in fine], "angle_max": [max(f) for f in fine],
        "reference_min": [min(f) for f in fine], "reference_max": [max(f) for f in fine],
        "torque_min": [s - 0.04 for s in swing], "torque_max": [s + 0.04 for s in swing],
    }  # fmt: skip


def response(kind="response", reached_hz=30.0, shift=1.0, **members):
    """A response with two modes, as the running estimate has it."""
    at = [0.3 * (60 / 0.3) ** (k / 399) for k in range(400)]
    values = []
    for f in at:
        s = 1j * f
        value = 0.05 * s * s / 10
        for hertz, strength in ((2.6, 1.0), (16.4, 0.8), (46.0, 0.6)):
            pole, zero = hertz * shift, 1.6 * hertz * shift
            value *= (zero**2 + s * s + 0.01 * s * zero) / (pole**2 + s * s + 0.01 * s * pole)
            value *= strength
        values.append(value)
    document = {
        "type": kind, "frequency_hz": at, "magnitude": [abs(v) for v in values],
        "phase_rad": [math.atan2(v.imag, v.real) for v in values], **members,
    }  # fmt: skip
    if kind == "response":
        document["coherence"] = [
            0.999 - 0.4 * math.exp(-(((f - 4.2) / 0.25) ** 2)) - (0.3 if f < 0.5 else 0.0)
            for f in at
        ]
        document["reached_hz"] = reached_hz
    return document


def measured(value, std, flag=None):
    return {
        "value": value, "std": std, "flag": flag,
        "interval_95": [value - 1.96 * std, value + 1.96 * std],
    }  # fmt: skip


MODES = [
    {"frequency_hz": measured(2.6113, 0.0008), "damping_ratio": measured(0.00342, 0.00012)},
    {"frequency_hz": measured(16.3721, 0.0021), "damping_ratio": measured(0.00511, 0.00009)},
    {"frequency_hz": measured(45.844, 0.011),
     "damping_ratio": measured(0.0078, 0.0004, "Near the end of the band.")},
]  # fmt: skip


def session(number, **members):
    name = f"20261120-1{number}1500-chirp"
    return {
        "id": name, "path": f"/data/sessions/{name}.mcap", "profile": "sim",
        "start_utc_ns": UTC_NS - number * 3_600 * 10**9, "specimen": "antenna 3",
        "operator": "R. Igge", "excitation": "chirp", "note": "", "outcome": "complete",
        "reason": "", "duration_s": 136.0, "scheduled": 136_000, "missed": 0, "late": 3,
        "lost": 0, "size_bytes": 8_400_000, "modes": MODES, "report": None,
        "meta": {"temperature_c": 21.4}, **members,
    }  # fmt: skip


def job(state, **members):
    return {
        "type": "job", "number": 1, "kind": "report", "id": "", "state": state, "error": "",
        "address": "", **members,
    }  # fmt: skip


QUICK_LOOK = {
    "version": 1, "modes": MODES, "coherence": {"mean": 0.981, "low_bands": [[4.0, 4.4]]},
    "flags": ["Damping of mode 3 is uncertain: near the end of the band."],
    "against_last": {
        "file": "20261119-101500-chirp.mcap",
        "sentence": "Against the session of 19 November: the second mode has changed.",
        "modes": [
            {"frequency_hz_change": -0.0021, "damping_ratio_change_percent": 1.3,
             "significant": False},
            {"frequency_hz_change": -0.071, "damping_ratio_change_percent": 12.0,
             "significant": True},
        ],
    },
}  # fmt: skip

PLAN = {
    "excitation": "chirp", "profile": "sim", "record_s": 136.0, "peak_angle_rad": 0.0251,
    "peak_velocity_rad_s": 7.85, "peak_torque_nm": 1.71, "peak_tracking_error_rad": 0.004,
    "peak_coupling_torque_nm": 0.31,
    "limits": {"angle_rad": 0.5, "velocity_rad_s": 10.0, "torque_nm": 1.8},
    "tip": {"deflection_m": 0.039, "slope_rad": 0.11, "speed_m_s": 0.8},
    "tip_in_words": "", "warnings": [], "refused": None,
}  # fmt: skip


class FakeWebServer:
    """Serves the page in its own thread; a test sets its messages and replies.

    Attributes
    ----------
    greeting
        Messages sent to every page when it connects.
    replies
        Replies to commands by their names; others succeed. None: no reply.
    commands
        Received requests: name of the command, and whether the token was right.
    """

    def __init__(self):
        self.greeting = [hello(), status()]
        self.replies = {"predict": {"plan": PLAN, "largest_amplitude_rad": 0.02867}}
        self.sessions = [session(k) for k in range(3)]
        self.commands = []
        self.requests = []
        self._pages = set()
        self._listening = threading.Event()
        self._thread = threading.Thread(target=self._work, daemon=True)
        self._thread.start()
        assert self._listening.wait(30.0)

    @property
    def address(self):
        return f"http://127.0.0.1:{self.port}/"

    def send(self, *messages):
        """Send messages to every page, and wait until they are sent."""
        asyncio.run_coroutine_threadsafe(self._send(messages), self._loop).result(30.0)

    def hang_up(self):
        """Close the connections of all pages."""
        asyncio.run_coroutine_threadsafe(self._hang_up(), self._loop).result(30.0)

    def close(self):
        if self._thread.is_alive():
            self._loop.call_soon_threadsafe(self._ending.set)
            self._thread.join(30.0)

    async def _send(self, messages):
        for page in list(self._pages):
            for message in messages:
                await page.send_json(message)

    async def _hang_up(self):
        for page in list(self._pages):
            await page.close()

    def _work(self):
        asyncio.run(self._serve())

    async def _serve(self):
        self._loop = asyncio.get_running_loop()
        self._ending = asyncio.Event()
        app = web.Application()
        app.router.add_get("/", self._index)
        app.router.add_get("/static/{name}", self._index)
        app.router.add_get("/api/live", self._live)
        app.router.add_post("/api/command", self._command)
        app.router.add_get("/api/sessions", self._list)
        app.router.add_get("/api/sessions/{id}/look", self._quick_look)
        app.router.add_get("/api/sessions/{id}/file.mat", self._never)
        app.router.add_post("/api/sessions/{id}/report", self._job)
        app.router.add_post("/api/campaign", self._job)
        app.router.add_get("/api/frf", self._frf)
        runner = web.AppRunner(app, access_log=None, shutdown_timeout=0.1)
        await runner.setup()
        site = web.TCPSite(runner, "127.0.0.1", 0)
        await site.start()
        self.port = runner.addresses[0][1]
        self._listening.set()
        await self._ending.wait()
        await self._hang_up()
        await runner.cleanup()

    async def _index(self, request):
        name = request.match_info.get("name", "index.html")
        return web.FileResponse(STATIC / name, headers={"Content-Security-Policy": POLICY})

    async def _live(self, request):
        page = web.WebSocketResponse()
        await page.prepare(request)
        for message in self.greeting:
            await page.send_json(message)
        self._pages.add(page)
        async for message in page:
            self.commands.append((message.data, False))
            if message.data in self.replies and self.replies[message.data] is not None:
                await page.send_json(
                    {"type": message.data, "ok": True, **self.replies[message.data]}
                )
        self._pages.discard(page)
        return page

    async def _command(self, request):
        body = await request.json()
        right = request.headers.get("Authorization") == f"Bearer {TOKEN}"
        assert request.headers["X-Rigd"] == "1"
        self.commands.append((body["command"], right))
        self.requests.append(body)
        reply = {"ok": True, **self.replies.get(body["command"], {})}
        return web.json_response(reply, status=200 if reply["ok"] else 409)

    async def _list(self, request):
        wanted = {k: v for k, v in request.query.items() if k in ("specimen", "outcome")}
        found = [s for s in self.sessions if all(s[k] == v for k, v in wanted.items())]
        limit = int(request.query["limit"])
        return web.json_response({"total": len(found), "sessions": found[:limit]})

    async def _quick_look(self, request):
        return web.json_response(QUICK_LOOK)

    async def _never(self, request):
        self.commands.append(("file", False))
        await self._ending.wait()
        return web.Response()

    async def _job(self, request):
        self.commands.append((request.path, "Authorization" in request.headers))
        await self._send([job("running", kind=request.path.split("/")[-1])])
        return web.json_response({"ok": True, "job": 1}, status=202)

    async def _frf(self, request):
        names = request.query["ids"].split(",")
        responses = [
            {"id": name, "specimen": "antenna 3", "model": None, **response(shift=1 + 0.02 * k)}
            for k, name in enumerate(names)
        ]
        # Of the first there is a fitted model, and of the third not even the coherence.
        first = response("model")
        limits = {"magnitude_low_95": 0.9, "magnitude_high_95": 1.1}
        band = {name: [x * value for value in first["magnitude"]] for name, x in limits.items()}
        responses[0]["model"] = {**first, **band}
        if len(responses) > 2:
            responses[2]["coherence"] = None
        return web.json_response({"responses": responses, "errors": []})


@contextmanager
def fake_web_server():
    """A server for the length of a block."""
    server = FakeWebServer()
    try:
        yield server
    finally:
        server.close()
