"""Blender in a window on a virtual screen: real mouse and keys go in, pictures and answers come out."""

from __future__ import annotations

import json
import os
import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from tree import ROOT, Tree

from engine.job import LiftFolder, last_run
from engine.machine.compiled import CACHE_FOLDER
from tests.waiting import PATIENCE_S, wait_until

SIZE = (1280, 1000)
"""Of the screen and of Blender's window on it, in pixels: a sidebar with all panels fits."""
ROW_STEP = 16
"""Less than the height of a button, so that none is missed when a column is searched."""
_MOVED_S, _PRESSED_S = 0.04, 0.06


class Window:
    """One Blender with the installed extension, which can be quit and started again."""

    def __init__(self, tree: Tree, folder: Path, package: Path) -> None:
        """Start a virtual screen and install the extension. `folder` is seen from inside the tree too."""
        self.folder, self._tree, self._blender = folder, tree, None
        self._log = (folder / "blender.log").open("ab")
        self._number, self.space = 0, "VIEW_3D"
        self._buttons: dict[str, tuple[int, int]] = {}
        for name in ("home", "screen"):
            (folder / name).mkdir(exist_ok=True)
        begun = shutil.ignore_patterns("*.tmp.*")  # by another process, while the kernels are copied for lifts here
        shutil.copytree(CACHE_FOLDER, folder / "kernels" / CACHE_FOLDER.name, ignore=begun)
        tree.environment |= {
            "HOME": str(folder / "home"),
            "BLENDER_USER_RESOURCES": str(folder / "resources"),
            "LIBGL_ALWAYS_SOFTWARE": "1",
            "MESA_SHADER_CACHE_DIR": str(ROOT / "build" / "window" / "shaders"),  # a third of a start
            "NUMBA_CACHE_DIR": str(folder / "kernels"),
            "PLGS_ENGINE_PYTHON": str(ROOT / ".venv" / "bin" / "python"),
        }
        self._start_screen()
        install = ["blender", "--command", "extension", "install-file", "-r", "user_default", "-e", str(package)]
        tree.run(*install)

    def _start_screen(self) -> None:
        reading, writing = os.pipe()
        self._screen = self._tree.start(
            "Xvfb", "-displayfd", str(writing), "-screen", "0", f"{SIZE[0]}x{SIZE[1]}x24", "-nolisten", "tcp",
            "-fbdir", str(self.folder / "screen"), "+extension", "GLX", log=self._log.fileno(), pass_fds=[writing],
        )  # fmt: skip
        os.close(writing)
        with os.fdopen(reading) as pipe:
            number = pipe.readline().strip()
        assert number, f"the virtual screen did not start: {self.log_tail()}"
        self._tree.environment["DISPLAY"] = f":{number}"

    # Blender's life

    def start(self) -> None:
        """Start Blender with its usual startup file, and wait until it answers and has drawn."""
        questions = self.folder / f"questions-{time.monotonic_ns()}"
        questions.mkdir()
        self._questions, self._number = questions, 0
        self._blender = self._tree.start(
            "blender", "--window-geometry", "0", "0", str(SIZE[0]), str(SIZE[1]),
            "--python", str(Path(__file__).parent / "inside.py"),
            log=self._log.fileno(), environment={"PLGS_WINDOW_QUESTIONS": str(questions)},
        )  # fmt: skip
        self.ask("bpy.app.version_string")
        self.settle()

    def quit(self) -> None:
        """Close Blender as File > Quit does; what it had to say about unsaved changes is not asked."""
        assert self._blender is not None
        self._send("bpy.ops.wm.quit_blender()")
        self._blender.wait(timeout=PATIENCE_S)
        self._blender = None

    def kill(self) -> None:
        """End Blender as the kernel does when memory runs out."""
        assert self._blender is not None
        self._blender.kill()  # and with that process the one in the tree
        self._blender.wait(timeout=PATIENCE_S)
        self._blender = None

    @property
    def is_running(self) -> bool:
        return self._blender is not None and self._blender.poll() is None

    def new_file(self, *, is_solid: bool = True) -> None:
        """File > New, and what was measured is forgotten. Solid shading of a user's own, which the extension keeps:
        Material Preview takes a processor that stands in for a graphics card a minute to begin with, and then long for
        each frame. Where that is to be seen, ``is_solid`` is False, and the processor is taken for a graphics card.
        """
        if not self.is_running:
            self.start()
        self.space = "VIEW_3D"
        self.run("bpy.ops.wm.read_homefile(use_splash=False)" + (_SOLID if is_solid else ""))
        self.run(_GRAPHICS_CARD.format(is_solid))
        self.run("watch.begin()")
        self.move(SIZE[0] // 2, SIZE[1] // 2)

    def place(self, lift: Path, then: str = "") -> None:
        """Show a finished lift, and run statements before the window is drawn."""
        self.run(f"bpy.ops.plgs.place_lift(lift_folder={str(lift)!r})\n{then}")

    # Questions and answers

    def ask(self, expression: str, timeout: float = PATIENCE_S) -> Any:
        """The value of a Python expression inside Blender, as JSON brings it. RuntimeError with Blender's traceback."""
        answer = self._answer_to(self._send(expression), timeout)
        if "error" in answer:
            raise RuntimeError(f"in Blender:\n{answer['error']}")
        return answer["value"]

    def run(self, statements: str, timeout: float = PATIENCE_S) -> Any:
        """Run Python statements inside Blender; what they leave in `answer`."""
        return self.ask(f"{statements}\n", timeout) if "\n" in statements else self.ask(f"{statements};", timeout)

    def _send(self, question: str) -> Path:
        self._number += 1
        unfinished = self._questions / f"{self._number}.new"
        unfinished.write_text(question)
        unfinished.replace(self._questions / f"{self._number}.py")
        return self._questions / f"{self._number}.json"

    def _answer_to(self, path: Path, timeout: float) -> dict[str, Any]:
        wait_until(lambda: path.exists() or not self.is_running, f"an answer of Blender ({path.stem})", timeout, 0.005)
        if not path.exists():
            raise RuntimeError(f"Blender has ended:\n{self.log_tail()}")
        answer: dict[str, Any] = json.loads(path.read_text())
        return answer

    def wait_for(self, expression: str, timeout: float = PATIENCE_S) -> None:
        """Wait until the expression is true inside Blender."""
        wait_until(lambda: self.ask(expression), expression, timeout, 0.1)

    @contextmanager
    def suspended(self, lift: Path) -> Iterator[None]:
        """Let the engine of a lift stand still within a ``with`` block, so that nothing of it passes by."""
        engine = next(event.data["pid"] for event in last_run(LiftFolder.open(lift).events_path))
        self.run(f"import os, signal; os.kill({engine}, signal.SIGSTOP)")  # there processes have other numbers
        try:
            yield
        finally:
            self.run(f"os.kill({engine}, signal.SIGCONT)")

    # Mouse and keys

    def move(self, x: int, y: int) -> None:
        """Move the mouse there; y counts downwards from the top of the screen. In two moves, as Blender wants."""
        self._input("mousemove", str(x - 2), str(y), "sleep", str(_MOVED_S), "mousemove", str(x), str(y))

    def click(self, x: int, y: int, button: int = 1) -> None:
        """Move there and click; 1 is the left button, 4 and 5 the wheel."""
        self.move(x, y)
        self._input("sleep", str(_PRESSED_S), "click", str(button))
        self._wait_for_events()

    def drag(self, start: tuple[int, int], end: tuple[int, int], *held: str) -> None:
        """Press the left button at the start, move to the end, and let it go, with keys held down: `shift`.

        Step by step: Blender takes the mouse to be where it is when it gets to a press.
        """
        self.move(*start)
        for each in held:
            self._input("keydown", each)
        self._wait_for_events()
        self._input("mousedown", "1", "sleep", str(_PRESSED_S))
        self._wait_for_events()
        for share in (0.25, 0.5, 0.75, 1.0):
            x, y = (round(a + share * (b - a)) for a, b in zip(start, end, strict=True))
            self._input("mousemove", str(x), str(y), "sleep", str(_MOVED_S))
            self._wait_for_events()
        self._input("mouseup", "1")
        for each in held:
            self._input("keyup", each)
        self._wait_for_events()

    def key(self, *keys: str) -> None:
        """Press keys one after the other where the mouse is: `Escape`, `n`, `ctrl+z`."""
        self._input("key", "--delay", "30", *keys)
        self._wait_for_events()

    def type(self, text: str) -> None:
        """Type into the field that is being edited."""
        self._input("type", "--delay", "10", text)
        self._wait_for_events()

    def drop(self, x: int, y: int, *paths: Path) -> None:
        """Drop files on the window there, as a file manager does."""
        self.move(x, y)
        source = Path(__file__).parent / "drag_source.py"
        self._tree.run("python3", str(source), str(x), str(y), *map(str, paths))
        self._wait_for_events()

    def _input(self, *arguments: str) -> None:
        self._tree.run("xdotool", *arguments)

    def _wait_for_events(self) -> None:
        """Blender handles what has arrived before it calls timers again; two rounds, for what that brought about."""
        for _ in range(2):
            if self.is_running:
                self.ask("None")

    # The sidebar

    def open_sidebar(self, tab: str = "PLGS") -> None:
        """Open the 3D view's sidebar with the key N, and its tab."""
        self.move(*self._middle("WINDOW"))
        if not self._region("UI")[2] > 1:
            self.key("n")
        # Tabs are known once the sidebar has been drawn.
        self.settle()
        self.run(self._in_sidebar() + f"region.active_panel_category = {tab!r}; region.tag_redraw()")
        self.settle()

    def find_button(self, operator: str, contains: str = "", near: int | None = None) -> tuple[int, int]:
        """Where in the sidebar the button of an operator is, such as "plgs.lift_scene"; greyed-out ones too.

        Found as a user can find out: the mouse stands on a button, Ctrl+C copies its Python command. `contains` tells
        apart buttons of one operator by their arguments. The search begins at the height `near`, or at the top: it
        takes a while, for while a lift runs Blender draws much. LookupError when there is none to be seen.
        """
        return self._find(f"bpy.ops.{operator}(", contains, "ctrl+c", near)

    def find_field(self, path: str, near: int | None = None) -> tuple[int, int]:
        """Where in the sidebar a property's field is, such as "plgs.preset", by its data path (Ctrl+Shift+Alt+C)."""
        return self._find("bpy.data.", f"].{path}", "ctrl+shift+alt+c", near)

    def press(self, operator: str, contains: str = "", near: int | None = None) -> tuple[int, int]:
        """Find an operator's button in the sidebar and click it; where it was. As panels grow by what engines tell,
        none is heard between a last look at what is under the mouse and the click.
        """
        for _ in range(5):
            x, y = self.find_button(operator, contains, near)
            with self._without_news():
                if f"bpy.ops.{operator}(" in (copied := self._copied_at(x, y, "ctrl+c")) and contains in copied:
                    self.click(x, y)
                    return x, y
        raise LookupError(f"the button of {operator} {contains} does not stay where it is")

    @contextmanager
    def _without_news(self) -> Iterator[None]:
        """Let the extension ask no engine for news within a ``with`` block."""
        self.run(_HOLD)
        try:
            yield
        finally:
            if self.is_running:
                self.run("if held: news.go_on()\n")

    def _find(self, begin: str, contains: str, keys: str, near: int | None) -> tuple[int, int]:
        left, top, width, height = self._region("UI")
        heights = sorted(range(top + 8, top + height, ROW_STEP), key=lambda y: abs(y - (near or 0)))
        # Where it was found earlier comes first: Blender draws for each place that is tried. Buttons share rows:
        # the middle hits most of them, the others stand at the sides. Tabs are at the right.
        earlier = [at for copied, at in self._buttons.items() if begin in copied and contains in copied]
        anywhere = [(left + int(width * share), y) for share in (0.45, 0.8, 0.15) for y in heights]
        for x, y in earlier + anywhere:
            copied = self._copied_at(x, y, keys)
            if copied:
                self._buttons[copied] = x, y
            if begin in copied and contains in copied:
                return x, y
        raise LookupError(f"no button of {begin} {contains} in the sidebar")

    def _copied_at(self, x: int, y: int, keys: str) -> str:
        """What these keys copy there; empty over nothing."""
        self._input("mousemove", str(x), str(y), "sleep", str(_MOVED_S), "key", keys)
        self.ask("None")  # the question is the second round
        copied: str = self.run("wm = bpy.context.window_manager\nanswer, wm.clipboard = wm.clipboard, ''")
        return copied

    def _region(self, kind: str) -> tuple[int, int, int, int]:
        """Left, top, width, height of the 3D view's region on the screen."""
        x, y, width, height = self.run(
            self._in_sidebar(kind) + "answer = region.x, region.y, region.width, region.height"
        )
        return x, SIZE[1] - y - height, width, height

    def _in_sidebar(self, kind: str = "UI") -> str:
        """Statements that find the region of that kind of the largest area of the editor `space`."""
        return _IN_SIDEBAR.replace("'UI'", repr(kind)).replace("'VIEW_3D'", repr(self.space))

    def _middle(self, kind: str) -> tuple[int, int]:
        x, y, width, height = self._region(kind)
        return x + width // 2, y + height // 2

    # What is seen, and how long it takes

    def picture(self) -> NDArray[np.uint8]:
        """The screen as it is now: uint8 [H, W, 3], red first. Read from the virtual screen's own memory."""
        dump = (self.folder / "screen" / "Xvfb_screen0").read_bytes()
        header = np.frombuffer(dump, ">u4", count=25)
        begin = int(header[0]) + 12 * int(header[19])  # of an X window dump: the header, then the colour map
        width, height, line = int(header[4]), int(header[5]), int(header[12])
        pixels = np.frombuffer(dump, np.uint8, offset=begin, count=line * height).reshape(height, line // 4, 4)
        return np.ascontiguousarray(pixels[:, :width, 2::-1])

    def screenshot(self, name: str) -> Path:
        """Keep the screen as a picture in build/window/screenshots."""
        path = ROOT / "build" / "window" / "screenshots" / f"{name}.png"
        path.parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(path), self.picture()[:, :, ::-1])
        return path

    def settle(self, timeout: float = PATIENCE_S, still_s: float = 0.4) -> None:
        """Wait until the screen has not changed for a while."""
        last, since, end = self.picture(), time.monotonic(), time.monotonic() + timeout
        while time.monotonic() - since < still_s:
            if time.monotonic() > end:
                raise TimeoutError(f"the screen does not come to rest within {timeout:g} s")
            self.ask("None", timeout)
            time.sleep(0.05)
            now = self.picture()
            if not np.array_equal(now, last):
                last, since = now, time.monotonic()

    def waits(self) -> dict[str, float]:
        """Seconds that Blender's window waited for each part of the extension at worst, since the file was new.

        By what Blender called: a panel's `draw`, an operator, a timer. What a test asked for itself is not counted.
        """
        found: dict[str, float] = self.ask("watch.waits")
        return found

    def slow_calls(self, limit_s: float) -> dict[str, tuple[float, float]]:
        """The calls of `waits` that took so long more than once, or once three times as long, with both times: once,
        any call may meet what is slow by chance, such as a page of memory that comes from the disk.
        """
        again = self.ask("watch.again")
        pairs = {call: (wait, again[call]) for call, wait in self.waits().items()}
        assert pairs, "nothing was measured"
        return {call: pair for call, pair in pairs.items() if pair[1] >= limit_s or pair[0] >= 3 * limit_s}

    def log_tail(self) -> str:
        """The last lines of what Blender and the virtual screen wrote."""
        self._log.flush()
        return "\n".join((self.folder / "blender.log").read_text(errors="replace").splitlines()[-30:])

    def close(self) -> None:
        """End Blender and the screen."""
        for process in (self._blender, self._screen):
            if process is not None:
                process.kill()
                process.wait()
        self._log.close()


_SOLID = """
for space in [area.spaces.active for screen in bpy.data.screens for area in screen.areas if area.type == 'VIEW_3D']:
    space.shading.type, space.shading.color_type, space.shading.wireframe_color_type = 'SOLID', 'OBJECT', 'OBJECT'
    space.shading.show_backface_culling, space.clip_start = True, 0.01
    space.overlay.show_relationship_lines = space.overlay.show_floor = False
"""
_GRAPHICS_CARD = """
import sys
sys.modules[EXTENSION + '.plgs_blender.viewport'].draws_in_software = lambda: {}
"""
_HOLD = """
import sys
news = sys.modules[EXTENSION + '.plgs_blender.registry']
held = bpy.app.timers.is_registered(news.tick)
if held:
    bpy.app.timers.unregister(news.tick)
"""
_IN_SIDEBAR = """
window = bpy.context.window_manager.windows[0]
area = max((each for each in window.screen.areas if each.type == 'VIEW_3D'), key=lambda each: each.width * each.height)
region = next(each for each in area.regions if each.type == 'UI')
"""
