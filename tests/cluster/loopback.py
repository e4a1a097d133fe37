"""A SLURM of one node on this machine, for tests and for trying the profile out, by root and with Debian's packages:

    apt-get install --no-install-recommends slurmd slurmctld slurm-client munge
    apt-get install --no-install-recommends slurmdbd slurm-wlm-mysql-plugin mariadb-server  # for --accounts
    python tests/cluster/loopback.py -- sbatch --wait --wrap hostname

Its configuration is linked to /etc/slurm while it runs, where jobs look for it; where one is there nothing is started.
Nothing listens beyond the loopback interface. The node says that it has 16 processors, 64 GB and two GPUs, whatever
there is. It keeps no accounts, or, with --accounts, has an accounting database (slurmdbd on MariaDB) in which root
has one. All ends with the command.
"""

import argparse
import contextlib
import os
import shutil
import signal
import socket
import stat
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

PROGRAMS = ("slurmctld", "slurmd", "sbatch", "munged")
ACCOUNTING = ("slurmdbd", "sacctmgr", "mariadbd", "mariadb-install-db")
PATIENCE_S = 60.0
CONFIGURATION = Path("/etc/slurm/slurm.conf")

_CONFIGURATION = """
ClusterName=loopback
SlurmctldHost={host}(127.0.0.1)
SlurmctldPort={controller}
SlurmdPort={daemon}
AuthType=auth/munge
AuthInfo=socket={folder}/munge.socket
SlurmUser=root
SlurmdUser=root
SlurmdParameters=config_overrides
StateSaveLocation={folder}/state
SlurmdSpoolDir={folder}/spool
SlurmctldPidFile={folder}/slurmctld.pid
SlurmdPidFile={folder}/slurmd.pid
SlurmctldLogFile={folder}/slurmctld.log
SlurmdLogFile={folder}/slurmd.log
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
MpiDefault=none
ReturnToService=2
SchedulerParameters=sched_interval=1,sched_min_interval=0,bf_interval=1
SelectType=select/cons_tres
SelectTypeParameters=CR_CPU_Memory
JobAcctGatherType=jobacct_gather/linux
JobAcctGatherFrequency=task=1
JobAcctGatherParams=OverMemoryKill
{accounting}
KillWait=5
MinJobAge=600
InactiveLimit=0
GresTypes=gpu
NodeName={host} NodeAddr=127.0.0.1 CPUs=16 RealMemory=64000 Gres=gpu:2 State=UNKNOWN
PartitionName=local Nodes={host} Default=YES MaxTime=INFINITE State=UP
"""


_ACCOUNTING = """
AccountingStorageType=accounting_storage/slurmdbd
AccountingStorageHost=127.0.0.1
AccountingStoragePort={port}
AccountingStoragePass={folder}/munge.socket
"""
_DATABASE = """
DbdHost=localhost
DbdAddr=127.0.0.1
DbdPort={port}
AuthType=auth/munge
AuthInfo=socket={folder}/munge.socket
SlurmUser=root
LogFile={folder}/slurmdbd.log
PidFile={folder}/slurmdbd.pid
StorageType=accounting_storage/mysql
StorageHost=127.0.0.1
StoragePort={storage}
StorageUser=root
StorageLoc=slurm
"""
_FILES = ("slurm.conf", "gres.conf", "slurmdbd.conf")


def available(accounts: bool = False) -> bool:
    """Whether a SLURM can be started here."""
    free = not any(os.path.lexists(CONFIGURATION.with_name(name)) for name in _FILES)
    programs = (*PROGRAMS, *(ACCOUNTING if accounts else ()))
    return os.geteuid() == 0 and free and all(shutil.which(name, path=_path()) for name in programs)


@contextlib.contextmanager
def slurm(accounts: bool = False) -> Iterator[dict[str, str]]:
    """Starts the node; yields the environment in which its commands find it, and stops it."""
    folder = Path(tempfile.mkdtemp(prefix="slurm-", dir="/tmp"))
    folder.chmod(0o755)
    environment = os.environ | {"PATH": _path()}
    host = os.uname().nodename.split(".")[0]
    for name in ("state", "spool"):
        (folder / name).mkdir()
    for name in ("gpu0", "gpu1"):  # a GPU is a character device for SLURM; these are twins of /dev/null
        os.mknod(folder / name, 0o666 | stat.S_IFCHR, os.makedev(1, 3))
    database, storage = _free_port(), _free_port()
    accounting = "AccountingStorageType=accounting_storage/none"
    if accounts:
        accounting = _ACCOUNTING.format(folder=folder, port=database)
        (folder / "slurmdbd.conf").write_text(_DATABASE.format(folder=folder, port=database, storage=storage))
        (folder / "slurmdbd.conf").chmod(0o600)
    (folder / "slurm.conf").write_text(
        _CONFIGURATION.format(
            host=host, folder=folder, controller=_free_port(), daemon=_free_port(), accounting=accounting,
        )
    )  # fmt: skip
    (folder / "gres.conf").write_text(f"NodeName={host} Name=gpu File={folder}/gpu[0-1]\n")
    key = folder / "munge.key"
    key.write_bytes(os.urandom(1024))
    key.chmod(0o400)
    daemons: list[subprocess.Popen[bytes]] = []

    def daemon(*words: str) -> None:
        log = open(folder / f"{Path(words[0]).name}.out", "wb")
        daemons.append(subprocess.Popen(words, env=environment, stdout=log, stderr=log, start_new_session=True))

    try:
        CONFIGURATION.parent.mkdir(exist_ok=True)
        for name in _FILES:
            if (folder / name).exists():
                CONFIGURATION.with_name(name).symlink_to(folder / name)
        files = {"key-file": key, "socket": folder / "munge.socket", "pid-file": folder / "munged.pid",
                 "log-file": folder / "munged.log", "seed-file": folder / "seed"}  # fmt: skip
        daemon("munged", "--foreground", "--force", *(f"--{option}={file}" for option, file in files.items()))
        _until(lambda: (folder / "munge.socket").exists(), folder)
        if accounts:
            _start_database(folder, storage, daemon)
            _until(lambda: _run(environment, "sacctmgr", "-i", "add", "cluster", "loopback"), folder)
        daemon("slurmctld", "-D")
        daemon("slurmd", "-D", "-N", host)
        idle = ["sinfo", "--noheader", "--format=%T"]
        _until(lambda: "idle" in subprocess.run(idle, env=environment, capture_output=True, text=True).stdout, folder)
        yield environment
    finally:
        with contextlib.suppress(OSError):
            subprocess.run(["scancel", "--user=root"], env=environment, capture_output=True, timeout=20)
        for process in reversed(daemons):
            process.terminate()
            try:
                process.wait(20)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
        for name in _FILES:
            if CONFIGURATION.with_name(name).resolve() == folder / name:
                CONFIGURATION.with_name(name).unlink()
        shutil.rmtree(folder, ignore_errors=True)


def _start_database(folder: Path, port: int, daemon: Callable[..., None]) -> None:
    """MariaDB in a folder of its own, and the accounting daemon on it."""
    data = folder / "database"
    make = ["mariadb-install-db", "--no-defaults", f"--datadir={data}", "--user=root", "--skip-test-db",
            "--auth-root-authentication-method=normal"]  # fmt: skip
    subprocess.run(make, check=True, capture_output=True, env=os.environ | {"PATH": _path()})
    daemon("mariadbd", "--no-defaults", "--user=root", f"--datadir={data}", f"--socket={folder}/maria.socket",
           f"--pid-file={folder}/maria.pid", "--bind-address=127.0.0.1", f"--port={port}")  # fmt: skip
    _until(lambda: (folder / "maria.socket").exists(), folder)
    daemon("slurmdbd", "-D")


def _run(environment: dict[str, str], *words: str) -> bool:
    return subprocess.run(words, env=environment, capture_output=True, timeout=30).returncode == 0


def _path() -> str:
    return os.pathsep.join([os.environ["PATH"], "/usr/sbin", "/sbin"])


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def _until(condition, folder: Path) -> None:
    end = time.monotonic() + PATIENCE_S
    while not condition():
        if time.monotonic() > end:
            said = "\n".join(path.read_text(errors="replace")[-1500:] for path in sorted(folder.glob("*.[lo]*[gt]")))
            raise TimeoutError(f"SLURM does not start:\n{said}")
        time.sleep(0.2)


def main() -> int:
    """Runs a command beside a SLURM."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--accounts", action="store_true", help="with an accounting database")
    parser.add_argument("command", nargs=argparse.REMAINDER, metavar="-- COMMAND ...")
    arguments = parser.parse_args()
    command = arguments.command[1:] if arguments.command[:1] == ["--"] else arguments.command
    if not command:
        parser.error("a command is needed after --")
    if not available(arguments.accounts):
        programs = ", ".join((*PROGRAMS, *(ACCOUNTING if arguments.accounts else ())))
        print(f"loopback: root, {programs}, and no {CONFIGURATION} of another are needed", file=sys.stderr)
        return 2
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # so that all of it ends then, too
    with slurm(arguments.accounts) as environment:
        return subprocess.run(command, env=environment).returncode


if __name__ == "__main__":
    sys.exit(main())
