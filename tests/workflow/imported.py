"""Snakemake, imported once: each call is a process of its own all the same, forked from one that has imported it.

Half of what a plan of a small run costs is to import Snakemake and its plugins, and these tests make more than a
hundred plans.
"""

import atexit
import functools
import json
import subprocess
import sys
import tempfile
from pathlib import Path

# Takes one call a line: what to run with, and the files for its output. Answers with its exit code.
_SERVER = """
import json, os, signal, sys
from snakemake import cli
cli.get_argument_parser()  # imports the plugins
for line in sys.stdin:
    call = json.loads(line)
    child = os.fork()
    if child == 0:
        os.setsid()  # all of it can be ended
        for number, name in enumerate(("/dev/null", call["out"], call["err"])):
            os.dup2(os.open(name, os.O_RDWR), number)
        os.chdir(call["cwd"])
        os.environ.clear()
        os.environ.update(call["env"])
        sys.path[0:0] = call["env"]["PYTHONPATH"].split(os.pathsep)
        sys.argv = [cli.__file__, *call["words"]]
        try:
            cli.main(call["words"])
            code = 0
        except SystemExit as end:
            code = end.code if isinstance(end.code, int) else int(end.code is not None)
        except BaseException:
            sys.excepthook(*sys.exc_info())
            code = 1
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)
    signal.signal(signal.SIGALRM, lambda *_: os.killpg(child, signal.SIGKILL))
    signal.alarm(call["timeout"])
    code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    signal.alarm(0)
    print(code, flush=True)
"""


def snakemake(words: list[str], folder: Path, environment: dict[str, str]) -> subprocess.CompletedProcess[str]:
    """What `python -m snakemake WORDS` does and says in a folder; after five minutes it is killed."""
    with tempfile.NamedTemporaryFile("r") as out, tempfile.NamedTemporaryFile("r") as err:
        call = {
            "words": words,
            "cwd": str(folder),
            "env": environment,
            "out": out.name,
            "err": err.name,
            "timeout": 300,
        }
        server = _server()
        assert server.stdin is not None and server.stdout is not None
        server.stdin.write(json.dumps(call) + "\n")
        server.stdin.flush()
        code = int(server.stdout.readline())
        return subprocess.CompletedProcess(words, code, out.read(), err.read())


@functools.cache
def _server() -> "subprocess.Popen[str]":
    command = [sys.executable, "-c", _SERVER]
    server = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    atexit.register(server.communicate)  # it ends with its input
    return server
