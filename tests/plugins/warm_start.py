"""Run commands of this project in copies of a process that has imported the project already.

The imports of one `rigd` take half a second of a processor, a copy takes a twentieth. `run` is used
like that of `subprocess`, `start` like its `Popen`. The processes that a copy starts, such as those
of a session, are copies of it in turn. Behaviour at the start of Python itself is tested with
`subprocess`, and so are a session and an analysis from end to end. Within `children_copied` the
processes of a rig that the test's own process starts are copies of the latter.
"""

import atexit
import contextlib
import ctypes
import faulthandler
import functools
import gc
import inspect
import io
import json
import mmap
import os
import runpy
import selectors
import signal
import socket
import struct
import subprocess
import sys
import threading
import traceback
import warnings
from importlib import import_module
from pathlib import Path
from subprocess import DEVNULL, PIPE, STDOUT, CalledProcessError, CompletedProcess, TimeoutExpired

_MAX_REQUEST_BYTES = 1 << 17
_MAX_REPORT_BYTES = 1 << 16
_STARTS_THREADS = ("pyarrow", "rerun", "rerun_bindings")
"""Packages whose import starts threads, which would be missing in a copy."""
_RIG_PROCESSES = ("rigd.engine.", "rigd.runner.", "rigd.daemon.", "rigd.web")
"""Modules that copies start as copies; the live view's import starts threads."""
_PR_SET_MM, _PR_SET_MM_MAP = 35, 14  # linux/prctl.h
_report_to = []
"""Descriptor for the names of imported modules, in copies of the warm process."""


def run(command, *, capture_output=False, timeout=None, check=False, input=None, **options):  # noqa: A002
    """Run a command to its end, as `subprocess.run` does."""
    if capture_output:
        options |= {"stdout": PIPE, "stderr": PIPE}
    if input is not None:
        options["stdin"] = PIPE
    with start(command, **options) as process:
        try:
            output, errors = process.communicate(input, timeout=timeout)
        except BaseException:
            process.kill()
            raise
    if check and process.returncode:
        raise CalledProcessError(process.returncode, command, output, errors)
    return CompletedProcess(command, process.returncode, output, errors)


def _settings_of_python(environment):
    """Return the variables that Python reads when it starts."""
    names = ("PYTHON", "LC_", "LANG")
    return {name: value for name, value in environment.items() if name.startswith(names)}


_OWN_SETTINGS = _settings_of_python(os.environ)
_FILTERS = [
    ("ignore", None, category, None, 0) for category in (DeprecationWarning, ResourceWarning)
]
"""Warnings of a new process, which a test runner turns into errors."""


def start(command, *, env=None, packages=None, **options):
    """Start a command, in a new process if a limit or environment applies to Python's own start.

    Packages in the folder `packages` are installed for it.
    """
    env = dict(os.environ if env is None else env)
    if "preexec_fn" in options or _settings_of_python(env) != _OWN_SETTINGS:
        return subprocess.Popen(command, env=env, **options)
    if packages is not None:
        env["PYTHONPATH"] = os.fspath(packages)
    return Copy(list(map(os.fspath, command)), env, **options)


class Copy:
    """A command in a copy of the warm process, with the used part of `subprocess.Popen`."""

    def __init__(
        self, command, env, *, cwd=None, stdin=None, stdout=None, stderr=None, text=False,
        start_new_session=False,
    ):  # fmt: skip
        self.args = command
        self.returncode = None
        self.stdin = self.stdout = self.stderr = None
        self._communicated = []
        mode = "t" if text else "b"
        with contextlib.ExitStack() as of_the_copy:
            ends = []
            for number, given in enumerate((stdin, stdout, stderr)):
                if given == PIPE:
                    reading, writing = os.pipe()
                    mine, end = (reading, writing) if number else (writing, reading)
                    stream = os.fdopen(mine, f"{'r' if number else 'w'}{mode}")
                    setattr(self, ("stdin", "stdout", "stderr")[number], stream)
                    of_the_copy.callback(os.close, end)
                elif given == DEVNULL:
                    end = os.open(os.devnull, os.O_RDWR)
                    of_the_copy.callback(os.close, end)
                elif given == STDOUT:
                    end = ends[1]
                elif given is None:
                    end = number
                else:
                    end = given if isinstance(given, int) else given.fileno()
                ends.append(end)
            reading, writing = os.pipe()
            of_the_copy.callback(os.close, writing)
            self._status = os.fdopen(reading, "rb", buffering=0)
            job = [command, os.fspath(cwd or Path.cwd()), env, start_new_session]
            socket.send_fds(_warm_process(), [json.dumps(job).encode()], [*ends, writing])
        self.pid = self._next_status()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        for stream in (self.stdin, self.stdout, self.stderr):
            if stream:
                with contextlib.suppress(BrokenPipeError):
                    stream.close()
        self.wait()

    def _next_status(self):
        number = self._status.read(4)
        assert number, "the warm process has ended"
        return int.from_bytes(number, sys.byteorder, signed=True)

    def poll(self):
        with contextlib.suppress(TimeoutExpired):
            self.wait(0.0)
        return self.returncode

    def wait(self, timeout=None):
        if self.returncode is None:
            with selectors.DefaultSelector() as selector:
                selector.register(self._status, selectors.EVENT_READ)
                if not selector.select(timeout):
                    raise TimeoutExpired(self.args, timeout)
            self.returncode = self._next_status()
            self._status.close()
        return self.returncode

    def communicate(self, input=None, timeout=None):  # noqa: A002
        if not self._communicated:
            outputs = {}
            streams = [stream for stream in (self.stdout, self.stderr) if stream]
            jobs = [functools.partial(_read_all, stream, outputs) for stream in streams]
            if self.stdin:
                jobs.append(functools.partial(_write_all, self.stdin, input))
            threads = [threading.Thread(target=job, daemon=True) for job in jobs]
            self._communicated = [threads, outputs]
            for thread in threads:
                thread.start()
        threads, outputs = self._communicated
        for thread in threads:
            thread.join(timeout)
            if thread.is_alive():
                raise TimeoutExpired(self.args, timeout)
        self.wait(timeout)
        return outputs.get(self.stdout), outputs.get(self.stderr)

    def send_signal(self, number):
        if self.poll() is None:
            os.kill(self.pid, number)

    def terminate(self):
        self.send_signal(signal.SIGTERM)

    def kill(self):
        self.send_signal(signal.SIGKILL)


def _read_all(stream, outputs):
    outputs[stream] = stream.read()
    stream.close()


def _write_all(stream, content):
    with contextlib.suppress(BrokenPipeError), stream:
        if content:
            stream.write(content)


@functools.cache
def _warm_process():
    """Start the process that is copied; it ends with this one."""
    mine, other = socket.socketpair(type=socket.SOCK_SEQPACKET)
    command = [sys.executable, "-P", __file__, str(other.fileno())]
    process = subprocess.Popen(command, stdin=DEVNULL, pass_fds=[other.fileno()])
    other.close()

    def end():
        mine.close()
        process.wait()

    atexit.register(end)
    return mine


# The warm process


def _serve(requests):
    """Make the copies that are requested and report how they end; returns, in a copy, its job."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the tests to handle
    with selectors.DefaultSelector() as selector:
        selector.register(requests, selectors.EVENT_READ)
        while True:
            for key, _ in selector.select():
                if key.data:
                    selector.unregister(key.fd)
                    _finish(key.fd, *key.data)
                    continue
                content, descriptors, _, _ = socket.recv_fds(requests, _MAX_REQUEST_BYTES, 4)
                if not content:
                    sys.exit()
                imported, importing = os.pipe()
                gc.freeze()
                if not (pid := os.fork()):
                    requests.detach()
                    return json.loads(content), descriptors, importing
                for descriptor in (importing, *descriptors[:3]):
                    os.close(descriptor)
                data = pid, descriptors[3], imported
                selector.register(os.pidfd_open(pid), selectors.EVENT_READ, data)


def _finish(pidfd, pid, status, imported):
    """Report how a copy ended; later ones need not import the same modules."""
    os.close(pidfd)
    code = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
    with os.fdopen(status, "wb") as stream:
        stream.write(_number(code))
    os.set_blocking(imported, False)  # a child of the copy may still have the other end
    with contextlib.suppress(BlockingIOError):
        for name in os.read(imported, _MAX_REPORT_BYTES).decode().split():
            with contextlib.suppress(ImportError):
                import_module(name)
    os.close(imported)


def _become_new_process(job, descriptors, importing):
    """Make this copy like a process that has just started; return its command."""
    command, folder, environment, start_new_session = job
    os.environ.clear()
    os.environ.update(environment)
    os.chdir(folder)
    if start_new_session:
        os.setsid()
    signal.signal(signal.SIGINT, signal.default_int_handler)
    for number, descriptor in enumerate(descriptors[:3]):
        os.dup2(descriptor, number)
    os.write(descriptors[3], _number(os.getpid()))
    _report_to.append(os.dup2(importing, 3, inheritable=False))
    os.closerange(4, os.sysconf("SC_OPEN_MAX"))
    _open_standard_streams()
    if _settings_of_python(environment) != _OWN_SETTINGS:  # packages are installed for it
        sys.path.insert(0, environment["PYTHONPATH"])
        _OWN_SETTINGS["PYTHONPATH"] = environment["PYTHONPATH"]
    atexit.register(_report_imports, frozenset(sys.modules))
    subprocess.Popen = _PopenOfCopy
    return command


def _open_standard_streams():
    """Make streams of the standard descriptors, which have changed."""
    sys.stdin = sys.__stdin__ = os.fdopen(0, closefd=False)
    for number, name in ((1, "stdout"), (2, "stderr")):
        before = getattr(sys, name)
        stream = io.TextIOWrapper(
            os.fdopen(number, "wb", 0 if before.write_through else -1, closefd=False),
            before.encoding,
            before.errors,
            line_buffering=before.line_buffering or os.isatty(number),
            write_through=before.write_through,
        )
        setattr(sys, name, stream)
        setattr(sys, f"__{name}__", stream)


def _report_imports(before):
    if not _report_to:
        return
    new = (name for name in sys.modules if name not in before and not name.endswith("__main__"))
    harmless = [name for name in new if name.partition(".")[0] not in _STARTS_THREADS]
    with contextlib.suppress(BrokenPipeError):  # the tests are over
        os.write(*_report_to, "\n".join(harmless).encode())


def _run(command):
    program, *arguments = command
    if program == sys.executable:
        if arguments[0] == "-P":
            del arguments[0]
        else:
            sys.path.insert(0, str(Path.cwd()))
        option, module, *arguments = arguments
        assert option == "-m", command
        sys.argv = [module, *arguments]
        runpy.run_module(module, run_name="__main__", alter_sys=True)
    else:
        sys.argv = [program, *arguments]
        sys.path.insert(0, str(Path(program).parent))
        runpy.run_path(program, run_name="__main__")


# Processes that a copy starts


_EXECUTE_CHILD = inspect.signature(subprocess.Popen._execute_child)


class _PopenOfCopy(subprocess.Popen):
    """Start of a process by a copy: a process of the rig is a copy of the copy."""

    def _execute_child(self, *arguments):
        given = _EXECUTE_CHILD.bind(self, *arguments).arguments
        command, env = list(map(os.fspath, given["args"])), given["env"]
        if (
            command[:3] != [sys.executable, "-P", "-m"]
            or not command[3].startswith(_RIG_PROCESSES)
            or _settings_of_python(os.environ if env is None else env) != _OWN_SETTINGS
            or not _commands_can_be_stated()
        ):
            super()._execute_child(*arguments)
            return
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", DeprecationWarning)  # of threads
                self.pid = os.fork()
            if not self.pid:
                _be_child(command, given)
            self._child_created = True
        finally:
            pipes = ("p2cread", "p2cwrite", "c2pread", "c2pwrite", "errread", "errwrite")
            self._close_pipe_fds(*(given[name] for name in pipes))


def _be_child(command, given):
    """Run a command in this copy of a copy, as a new process would, and end it."""
    gc.freeze()  # garbage here has descriptors whose numbers will be reused
    exit_code = 1
    try:
        before = frozenset(sys.modules)
        _forget_parent(given)
        _state_command(command)
        try:
            _run(command)
            exit_code = 0
        except SystemExit as end:
            exit_code = end.code if isinstance(end.code, int) else int(end.code is not None)
        for thread in threading.enumerate():
            if thread is not threading.current_thread() and not thread.daemon:
                thread.join()
        atexit._run_exitfuncs()
        for stream in (sys.stdout, sys.stderr):
            stream.flush()
        _report_imports(before)
    except BaseException:
        traceback.print_exc()
    finally:
        os._exit(exit_code)  # the finalizers belong to objects of the parent


@contextlib.contextmanager
def children_copied():
    """Start processes of the rig, within this context, as copies of this process."""
    before, subprocess.Popen = subprocess.Popen, _PopenOfCopy
    try:
        yield
    finally:
        subprocess.Popen = before


_streams_of_parent = []
"""Streams whose content the parent will write."""


def _forget_parent(given):
    """Undo settings that a process does not inherit from its parent, and set those given."""
    atexit._clear()
    faulthandler.disable()
    signal.set_wakeup_fd(-1)
    sys.unraisablehook, threading.excepthook = sys.__unraisablehook__, threading.__excepthook__
    warnings.filters[:] = _FILTERS
    warnings._filters_mutated()
    for number in signal.valid_signals():
        if callable(signal.getsignal(number)):
            signal.signal(number, signal.SIG_DFL)
    if signal.getsignal(signal.SIGINT) is signal.SIG_DFL:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    if given["env"] is not None:
        os.environ.clear()
        os.environ.update(given["env"])
    if given["cwd"] is not None:
        os.chdir(given["cwd"])
    _streams_of_parent.extend((sys.stdin, sys.stdout, sys.stderr))
    for number, end in enumerate((given["p2cread"], given["c2pwrite"], given["errwrite"])):
        if end != -1:
            os.dup2(end, number)
    first = 4 if _report_to else 3
    for descriptor in (*sorted(given["pass_fds"]), os.sysconf("SC_OPEN_MAX")):
        os.closerange(first, descriptor)
        first = descriptor + 1
    _open_standard_streams()


_command_lines = []
"""Memory with the command lines that this process has had."""


def _state_command(command):
    """Have the process table show a command; the memory of the first one is too short for it."""
    content = b"".join(os.fsencode(word) + b"\0" for word in command)
    memory = mmap.mmap(-1, len(content), mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
    memory.write(content)
    _command_lines.append(memory)
    first = ctypes.addressof(ctypes.c_char.from_buffer(memory))
    _set_command_memory(first, first + len(content))


def _commands_can_be_stated():
    """Return whether the system lets a process change the command that the table shows."""
    try:
        _set_command_memory(*_addresses_of_process(48, 50))
    except OSError:
        return False
    return True


def _addresses_of_process(first, end):
    """Return fields of /proc/self/stat by their numbers in its documentation."""
    fields = Path("/proc/self/stat").read_text().rpartition(")")[2].split()
    return map(int, fields[first - 3 : end - 3])


def _set_command_memory(first, end):
    """Show a part of the memory in the process table."""
    code, code_end, stack = _addresses_of_process(26, 29)
    data, data_end, heap = _addresses_of_process(45, 48)
    environment = _addresses_of_process(50, 52)
    c = ctypes.CDLL(None, use_errno=True)
    c.sbrk.restype = ctypes.c_void_p
    regions = (code, code_end, data, data_end, heap, c.sbrk(0), stack, first, end, *environment)
    stated = struct.pack("=12QIi", *regions, 0, 0, -1)
    if c.prctl(_PR_SET_MM, _PR_SET_MM_MAP, stated, len(stated), 0):
        raise OSError(ctypes.get_errno(), "the command line cannot be set")


def _number(value):
    return value.to_bytes(4, sys.byteorder, signed=True)


if __name__ == "__main__":
    _run(_become_new_process(*_serve(socket.socket(fileno=int(sys.argv[1])))))
