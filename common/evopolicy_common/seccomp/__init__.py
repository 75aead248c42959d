"""Seccomp programs: assembles filters of system calls from classic BPF instructions.

A filter starts with `program`, which checks the architecture and loads the call's number; the body returns the
verdicts.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable

_Table = dict[str, dict[str, int]]


def _parsed(table: str) -> _Table:
    """`NAME=X86_64/AARCH64`, with `-` where an architecture has no such call, as numbers by architecture."""
    tables: _Table = {"x86_64": {}, "aarch64": {}}
    for entry in table.split():
        name, _, numbers = entry.partition("=")
        for calls, number in zip(tables.values(), numbers.split("/"), strict=True):
            if number != "-":
                calls[name] = int(number)
    return tables


NUMBERS = _parsed("""
read=0/63 write=1/64 readv=19/65 writev=20/66 pread64=17/67 pwrite64=18/68 preadv=295/69 pwritev=296/70
preadv2=327/286 pwritev2=328/287 lseek=8/62 close=3/57 close_range=436/436 dup=32/23 dup2=33/- dup3=292/24
pipe=22/- pipe2=293/59 open=2/- openat=257/56 openat2=437/437 creat=85/- access=21/- faccessat=269/48
faccessat2=439/439 stat=4/- fstat=5/80 lstat=6/- newfstatat=262/79 statx=332/291 statfs=137/43 fstatfs=138/44
readlink=89/- readlinkat=267/78 getdents=78/- getdents64=217/61 getcwd=79/17 chdir=80/49 fchdir=81/50
mkdir=83/- mkdirat=258/34 rmdir=84/- unlink=87/- unlinkat=263/35 rename=82/- renameat=264/38 renameat2=316/276
link=86/- linkat=265/37 symlink=88/- symlinkat=266/36 chmod=90/- fchmod=91/52 fchmodat=268/53 truncate=76/45
ftruncate=77/46 fallocate=285/47 fsync=74/82 fdatasync=75/83 utime=132/- utimes=235/- utimensat=280/88
futimesat=261/- umask=95/166 fadvise64=221/223 readahead=187/213 sendfile=40/71 copy_file_range=326/285
poll=7/- ppoll=271/73 select=23/- pselect6=270/72 eventfd=284/- eventfd2=290/19 timerfd_create=283/85
timerfd_settime=286/86 timerfd_gettime=287/87 mmap=9/222 munmap=11/215 mremap=25/216 mprotect=10/226
madvise=28/233 brk=12/214 msync=26/227 futex=202/98 set_robust_list=273/99 get_robust_list=274/100
rseq=334/293 set_tid_address=218/96 restart_syscall=219/128 rt_sigaction=13/134 rt_sigprocmask=14/135
rt_sigreturn=15/139 rt_sigpending=127/136 rt_sigsuspend=130/133 rt_sigtimedwait=128/137 sigaltstack=131/132
pause=34/- alarm=37/- getitimer=36/102 setitimer=38/103 nanosleep=35/101 clock_nanosleep=230/115
clock_gettime=228/113 clock_getres=229/114 gettimeofday=96/169 time=201/- times=100/153 getrusage=98/165
getpid=39/172 getppid=110/173 gettid=186/178 getuid=102/174 geteuid=107/175 getgid=104/176 getegid=108/177
getgroups=115/158 getresuid=118/148 getresgid=120/150 getpgrp=111/- getpgid=121/155 getsid=124/156
uname=63/160 getcpu=309/168 getrandom=318/278 getrlimit=97/163 prlimit64=302/261 sched_yield=24/124
sched_getaffinity=204/123 sched_getparam=143/121 sched_getscheduler=145/120 sched_get_priority_max=146/125
sched_get_priority_min=147/126 exit=60/93 exit_group=231/94 wait4=61/260 waitid=247/95 arch_prctl=158/-
getpriority=140/141 ioctl=16/29 fcntl=72/25 prctl=157/167 clone=56/220 clone3=435/435 fork=57/- vfork=58/-
kill=62/129 tgkill=234/131 listxattr=194/11 llistxattr=195/12 flistxattr=196/13 getxattr=191/8 lgetxattr=192/9
fgetxattr=193/10
""")
REFUSED = _parsed("""
unshare=272/97 setns=308/268 mount=165/40 umount2=166/39 pivot_root=155/41 chroot=161/51 open_tree=428/428
move_mount=429/429 fsopen=430/430 fsconfig=431/431 fsmount=432/432 fspick=433/433 mount_setattr=442/442
keyctl=250/219 add_key=248/217 request_key=249/218 ptrace=101/117 process_vm_readv=310/270
process_vm_writev=311/271 pidfd_getfd=438/438 kcmp=312/272 bpf=321/280 perf_event_open=298/241
userfaultfd=323/282 io_uring_setup=425/425 io_uring_enter=426/426 io_uring_register=427/427 kexec_load=246/104
kexec_file_load=320/294 init_module=175/105 finit_module=313/273 delete_module=176/106 reboot=169/142
swapon=167/224 swapoff=168/225 acct=163/89 quotactl=179/60 quotactl_fd=443/443 syslog=103/116
settimeofday=164/170 clock_settime=227/112 adjtimex=159/171 clock_adjtime=305/266 sethostname=170/161
setdomainname=171/162 open_by_handle_at=304/265 name_to_handle_at=303/264 fanotify_init=300/262
migrate_pages=256/238 move_pages=279/239
""")
"""Calls that create namespaces, and calls that no environment process needs and namespaces do not isolate."""
REACHING_OUT = _parsed(
    "kill=62/129 tkill=200/130 rt_sigqueueinfo=129/138 rt_tgsigqueueinfo=297/240 pidfd_open=434/434"
)
"""Calls that affect other processes of the same user."""
SET_AFFINITY = {"x86_64": 203, "aarch64": 122}
SOCKET = {"x86_64": 41, "aarch64": 198}
SECCOMP = {"x86_64": 317, "aarch64": 277}
MODES = _parsed("""
chmod=90/- fchmod=91/52 fchmodat=268/53 fchmodat2=452/452 mknod=133/- mknodat=259/33 creat=85/- open=2/-
openat=257/56 openat2=437/437
""")
"""Calls that give a file its mode. Those for folders are missing: the kernel keeps no set-id bit of their mode."""
ATTRIBUTES: dict[str, tuple[int, ...]] = {"x86_64": (188, 189, 190, 463), "aarch64": (5, 6, 7, 463)}
"""`setxattr`, `lsetxattr`, `fsetxattr` and `setxattrat`, which set access control lists and capabilities too."""


Instruction = tuple[int, int, int, int]
"""Opcode, number of instructions to skip when the condition holds and when it does not, and an operand."""

LOAD, AND = 0x20, 0x54
JUMP_EQUAL, JUMP_AT_LEAST, JUMP_ANY_BIT = 0x15, 0x35, 0x45
RETURN = 0x06
KILL_PROCESS, ERRNO, ALLOW = 0x80000000, 0x00050000, 0x7FFF0000
AUDIT_ARCH = {"x86_64": 0xC000003E, "aarch64": 0xC00000B7}
"""The kernel's architecture numbers by `platform.machine()`, for the architectures with tables of calls."""
_X32_BIT = 0x40000000
_NUMBER, _ARCHITECTURE = 0, 4

ALLOWED: Instruction = (RETURN, 0, 0, ALLOW)
KILLED: Instruction = (RETURN, 0, 0, KILL_PROCESS)


def program(machine: str, otherwise: Instruction, body: Iterable[Instruction]) -> bytes:
    """A complete filter, 8 bytes an instruction: `otherwise` applies to calls of another architecture,
    `body`, which begins with the call's number loaded, to the rest."""
    head = [
        (LOAD, 0, 0, _ARCHITECTURE),
        (JUMP_EQUAL, 1, 0, AUDIT_ARCH[machine]),
        otherwise,
        (LOAD, 0, 0, _NUMBER),
    ]
    if machine == "x86_64":
        head += [(JUMP_AT_LEAST, 0, 1, _X32_BIT), otherwise]
    return b"".join(struct.pack("<HBBI", *instruction) for instruction in (*head, *body))


def argument(index: int) -> int:
    """Offset of the low half of an argument (both architectures are little-endian)."""
    return 16 + 8 * index


def refuse(number: int) -> Instruction:
    """Makes the call fail with this errno; with 0 the call is accepted and ignored."""
    return (RETURN, 0, 0, ERRNO | number)


def one_of(index: int, allowed: Iterable[int], *otherwise: Instruction) -> list[Instruction]:
    """Allows a call whose argument `index` is one of `allowed`; runs `otherwise` for other values."""
    block: list[Instruction] = [(LOAD, 0, 0, argument(index))]
    for value in allowed:
        block += [(JUMP_EQUAL, 0, 1, value), ALLOWED]
    return [*block, *otherwise]
