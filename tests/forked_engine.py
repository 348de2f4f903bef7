"""A Python for the engine's commands that runs each in a fork of a process which has imported the engine and run its
kernels once: to start one takes three seconds of a processor otherwise, more than all else of a tiny lift.

forked_engine.py SOCKET is that process. It is not for tests of how an engine starts, or of what kills it.
"""

import gc
import json
import os
import signal
import socket
import subprocess
import sys
import threading
import traceback
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path

NETWORKS = {"segment", "depth", "film"}
"""Commands that run a network."""
SURFACES = "export"
"""The command that makes surfaces."""
PYTHON = """#!{python} -IS
import json, os, socket, sys
server = socket.socket(socket.AF_UNIX)
server.connect({address!r})
socket.send_fds(server, [b"."], [0, 1, 2])
server.sendall(json.dumps([sys.argv, os.getcwd(), dict(os.environ)]).encode() + b"\\n")
sys.exit(int(server.makefile().readline()))
"""


@contextmanager
def forked_engines(folder: Path) -> Iterator[Path]:
    """The path of the Python, within a ``with`` block."""
    from engine.job.process import engine_python

    engine = engine_python()  # this Python, or the one beside it where this is the next Blender's, without torch
    address, python = folder / "socket", folder / "python"
    python.write_text(PYTHON.format(python=sys.executable, address=str(address)))
    python.chmod(0o755)
    with socket.socket(socket.AF_UNIX) as listening:
        listening.bind(str(address))
        listening.listen()
        server = subprocess.Popen(
            [engine, __file__, str(listening.fileno())], pass_fds=[listening.fileno()],
            env=os.environ | {"OMP_NUM_THREADS": "1"},
        )  # fmt: skip
    try:
        yield python
    finally:
        server.kill()
        server.wait()


def serve(listening: socket.socket) -> None:
    """Run each command that comes, in a fork. Nothing is imported before the first comes: perhaps none does."""
    while True:
        client, _ = listening.accept()
        _, descriptors, *_ = socket.recv_fds(client, 1, 3)
        asked = client.makefile().readline()
        if not asked:  # the client was killed before it asked
            for descriptor in descriptors:
                os.close(descriptor)
            client.close()
            continue
        (sys.executable, *arguments), folder, environment = json.loads(asked)
        if arguments[:2] != ["-I", "-c"]:  # which only asks what can be imported, and does not wait long
            import_engine()
        if NETWORKS & {*arguments}:
            import_for_transformers()
        if SURFACES in arguments:
            import_open3d()
        gc.freeze()  # a fork does not copy what its collector would touch
        child = os.fork()
        if child == 0:
            for number, descriptor in enumerate(descriptors):
                os.dup2(descriptor, number)
            os.closerange(3, max(descriptors) + 1)
            os.chdir(folder)
            os.environ.clear()
            os.environ.update(environment)
            become(arguments)
        for descriptor in descriptors:
            os.close(descriptor)
        threading.Thread(target=await_end, args=(child, client), daemon=True).start()


@cache
def import_engine() -> None:
    """Import all of it, and run its kernels once."""
    import OpenEXR

    from engine.lift.warm_up import compile_rasteriser, lift_a_wall

    OpenEXR.set_global_thread_count(0)  # its threads do not follow into a fork, which would wait for them
    compile_rasteriser()
    lift_a_wall(lambda: None)


@cache
def import_for_transformers() -> None:
    """Import what transformers imports of torch, but not transformers, which reads the environment when imported."""
    import torch._dynamo
    import torch.distributed.tensor  # noqa: F401


@cache
def import_open3d() -> None:
    """Import it with all that it brings, which takes longer than the surface of a tiny room."""
    import open3d.t.geometry  # noqa: F401


def await_end(child: int, client: socket.socket) -> None:
    """Tell the client the child's exit code, and kill the child if the client is gone."""
    client.settimeout(0.02)
    while True:
        ended, status = os.waitpid(child, os.WNOHANG)
        if ended:
            with suppress(BrokenPipeError, ConnectionResetError):  # the client was killed
                client.sendall(b"%d\n" % (os.waitstatus_to_exitcode(status) & 255))
            return client.close()
        try:
            client.recv(1)
            os.kill(child, signal.SIGKILL)
        except TimeoutError:
            pass


def become(arguments: list[str]) -> None:
    """Do what a Python does with ``-c CODE …``, ``-m MODULE …`` or ``FILE …`` after its options. Does not return."""
    import runpy

    while arguments[0] in ("-I", "-u", "-s", "-P"):
        del arguments[0]
    code = 1
    try:
        if arguments[0] == "-c":
            program, sys.argv = arguments[1], ["-c", *arguments[2:]]
            exec(program, {"__name__": "__main__"})
        elif arguments[0] == "-m":
            sys.argv = arguments[1:]
            runpy.run_module(arguments[1], run_name="__main__", alter_sys=True)
        else:
            sys.argv = arguments
            runpy.run_path(arguments[0], run_name="__main__")
        code = 0
    except SystemExit as end:
        if isinstance(end.code, str):
            print(end.code, file=sys.stderr)
        code = end.code if isinstance(end.code, int) else int(end.code is not None)
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)


if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
    serve(socket.socket(fileno=int(sys.argv[1])))
