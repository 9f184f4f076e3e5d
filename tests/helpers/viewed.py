"""``neurad view`` on a thread of a test."""

import contextlib
import ctypes
import threading
import time

import pytest

from neurad.cli import main


@contextlib.contextmanager
def viewed(*words):
    """``neurad view`` on another thread until the block ends; gives the viewer."""
    from neurad.inspect.viewer import Viewer

    running, ended = [], []
    run = Viewer.run
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Viewer, "run", lambda self: (running.append(self), run(self)))

        def work():
            try:
                main(["view", *words])
            except BaseException as error:  # what a process would end with
                ended.append(error)

        thread = threading.Thread(target=work)
        thread.start()
        while not running and thread.is_alive():
            time.sleep(0.02)
        if ended:
            raise ended[0]
        try:
            yield running[0]
        finally:
            interrupt = ctypes.py_object(KeyboardInterrupt)  # as Ctrl-C does
            ctypes.pythonapi.PyThreadState_SetAsyncExc(ctypes.c_ulong(thread.ident), interrupt)
            thread.join(30)
            assert not thread.is_alive()
            assert ended == []
