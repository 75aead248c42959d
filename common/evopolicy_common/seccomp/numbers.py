"""Numbers of the system calls that the filters name, by architecture (from the kernel's unistd headers)."""

from __future__ import annotations

_X86_64 = """
read=0 write=1 readv=19 writev=20 pread64=17 pwrite64=18 preadv=295 pwritev=296 preadv2=327 pwritev2=328
lseek=8 close=3 close_range=436 dup=32 dup2=33 dup3=292 pipe=22 pipe2=293 open=2 openat=257 openat2=437
creat=85 access=21 faccessat=269 faccessat2=439 stat=4 fstat=5 lstat=6 newfstatat=262 statx=332
statfs=137 fstatfs=138 readlink=89 readlinkat=267 getdents=78 getdents64=217 getcwd=79 chdir=80 fchdir=81
mkdir=83 mkdirat=258 rmdir=84 unlink=87 unlinkat=263 rename=82 renameat=264 renameat2=316 link=86
linkat=265 symlink=88 symlinkat=266 chmod=90 fchmod=91 fchmodat=268 truncate=76 ftruncate=77
fallocate=285 fsync=74 fdatasync=75 utime=132 utimes=235 utimensat=280 futimesat=261 umask=95
fadvise64=221 readahead=187 sendfile=40 copy_file_range=326 poll=7 ppoll=271 select=23 pselect6=270
eventfd=284 eventfd2=290 timerfd_create=283 timerfd_settime=286 timerfd_gettime=287 mmap=9 munmap=11
mremap=25 mprotect=10 madvise=28 brk=12 msync=26 futex=202 set_robust_list=273
get_robust_list=274 rseq=334 set_tid_address=218 restart_syscall=219 rt_sigaction=13 rt_sigprocmask=14
rt_sigreturn=15 rt_sigpending=127 rt_sigsuspend=130 rt_sigtimedwait=128 sigaltstack=131 pause=34 alarm=37
getitimer=36 setitimer=38 nanosleep=35 clock_nanosleep=230 clock_gettime=228 clock_getres=229
gettimeofday=96 time=201 times=100 getrusage=98
getpid=39 getppid=110 gettid=186 getuid=102 geteuid=107 getgid=104
getegid=108 getgroups=115 getresuid=118 getresgid=120 getpgrp=111 getpgid=121 getsid=124 uname=63
getcpu=309 getrandom=318 getrlimit=97 prlimit64=302 sched_yield=24
sched_getaffinity=204 sched_getparam=143 sched_getscheduler=145 sched_get_priority_max=146
sched_get_priority_min=147 exit=60 exit_group=231 wait4=61 waitid=247 arch_prctl=158 getpriority=140
ioctl=16 fcntl=72 prctl=157 clone=56 clone3=435 fork=57 vfork=58 kill=62 tgkill=234
listxattr=194 llistxattr=195 flistxattr=196 getxattr=191 lgetxattr=192 fgetxattr=193
"""

_AARCH64 = """
read=63 write=64 readv=65 writev=66 pread64=67 pwrite64=68 preadv=69 pwritev=70 preadv2=286 pwritev2=287
lseek=62 close=57 close_range=436 dup=23 dup3=24 pipe2=59 openat=56 openat2=437 faccessat=48
faccessat2=439 fstat=80 newfstatat=79 statx=291 statfs=43 fstatfs=44 readlinkat=78 getdents64=61
getcwd=17 chdir=49 fchdir=50 mkdirat=34 unlinkat=35 renameat=38 renameat2=276 linkat=37 symlinkat=36
fchmod=52 fchmodat=53 truncate=45 ftruncate=46 fallocate=47 fsync=82 fdatasync=83 utimensat=88 umask=166
fadvise64=223 readahead=213 sendfile=71 copy_file_range=285 ppoll=73 pselect6=72
eventfd2=19 timerfd_create=85 timerfd_settime=86
timerfd_gettime=87 mmap=222 munmap=215 mremap=216 mprotect=226 madvise=233 brk=214 msync=227
futex=98 set_robust_list=99 get_robust_list=100 rseq=293 set_tid_address=96
restart_syscall=128 rt_sigaction=134 rt_sigprocmask=135 rt_sigreturn=139 rt_sigpending=136
rt_sigsuspend=133 rt_sigtimedwait=137 sigaltstack=132 getitimer=102 setitimer=103 nanosleep=101
clock_nanosleep=115 clock_gettime=113 clock_getres=114 gettimeofday=169 times=153 getrusage=165
getpid=172
getppid=173 gettid=178 getuid=174 geteuid=175 getgid=176 getegid=177 getgroups=158 getresuid=148
getresgid=150 getpgid=155 getsid=156 uname=160 getcpu=168 getrandom=278 getrlimit=163
prlimit64=261 sched_yield=124 sched_getaffinity=123 sched_getparam=121
sched_getscheduler=120 sched_get_priority_max=125 sched_get_priority_min=126 exit=93 exit_group=94
wait4=260 waitid=95 getpriority=141 ioctl=29 fcntl=25 prctl=167 clone=220 clone3=435 kill=129 tgkill=131
listxattr=11 llistxattr=12 flistxattr=13 getxattr=8 lgetxattr=9 fgetxattr=10
"""


def _parsed(table: str) -> dict[str, int]:
    pairs = (entry.split("=") for entry in table.split())
    return {name: int(number) for name, number in pairs}


NUMBERS: dict[str, dict[str, int]] = {"x86_64": _parsed(_X86_64), "aarch64": _parsed(_AARCH64)}

_X86_64_REFUSED = """
unshare=272 setns=308 mount=165 umount2=166 pivot_root=155 chroot=161 open_tree=428 move_mount=429 fsopen=430
fsconfig=431 fsmount=432 fspick=433 mount_setattr=442 keyctl=250 add_key=248 request_key=249 ptrace=101
process_vm_readv=310 process_vm_writev=311 pidfd_getfd=438 kcmp=312 bpf=321 perf_event_open=298 userfaultfd=323
io_uring_setup=425 io_uring_enter=426 io_uring_register=427 kexec_load=246 kexec_file_load=320 init_module=175
finit_module=313 delete_module=176 reboot=169 swapon=167 swapoff=168 acct=163 quotactl=179 quotactl_fd=443
syslog=103 settimeofday=164 clock_settime=227 adjtimex=159 clock_adjtime=305 sethostname=170 setdomainname=171
open_by_handle_at=304 name_to_handle_at=303 fanotify_init=300 migrate_pages=256 move_pages=279
"""

_AARCH64_REFUSED = """
unshare=97 setns=268 mount=40 umount2=39 pivot_root=41 chroot=51 open_tree=428 move_mount=429 fsopen=430
fsconfig=431 fsmount=432 fspick=433 mount_setattr=442 keyctl=219 add_key=217 request_key=218 ptrace=117
process_vm_readv=270 process_vm_writev=271 pidfd_getfd=438 kcmp=272 bpf=280 perf_event_open=241 userfaultfd=282
io_uring_setup=425 io_uring_enter=426 io_uring_register=427 kexec_load=104 kexec_file_load=294 init_module=105
finit_module=273 delete_module=106 reboot=142 swapon=224 swapoff=225 acct=89 quotactl=60 quotactl_fd=443
syslog=116 settimeofday=170 clock_settime=112 adjtimex=171 clock_adjtime=266 sethostname=161 setdomainname=162
open_by_handle_at=265 name_to_handle_at=264 fanotify_init=262 migrate_pages=238 move_pages=239
"""

REFUSED: dict[str, dict[str, int]] = {
    "x86_64": _parsed(_X86_64_REFUSED),
    "aarch64": _parsed(_AARCH64_REFUSED),
}
"""Calls that create namespaces, and calls that no environment process needs and namespaces do not isolate."""
REACHING_OUT: dict[str, dict[str, int]] = {
    "x86_64": _parsed("kill=62 tkill=200 rt_sigqueueinfo=129 rt_tgsigqueueinfo=297 pidfd_open=434"),
    "aarch64": _parsed("kill=129 tkill=130 rt_sigqueueinfo=138 rt_tgsigqueueinfo=240 pidfd_open=434"),
}
"""Calls that affect other processes of the same user."""
SET_AFFINITY = {"x86_64": 203, "aarch64": 122}
"""`sched_setaffinity`."""
SOCKET = {"x86_64": 41, "aarch64": 198}
SECCOMP = {"x86_64": 317, "aarch64": 277}
MODES: dict[str, dict[str, int]] = {
    "x86_64": _parsed(
        "chmod=90 fchmod=91 fchmodat=268 fchmodat2=452 mknod=133 mknodat=259 creat=85 open=2 openat=257 openat2=437"
    ),
    "aarch64": _parsed("fchmod=52 fchmodat=53 fchmodat2=452 mknodat=33 openat=56 openat2=437"),
}
"""Calls that give a file its mode. Those for folders are missing: the kernel keeps no set-id bit of their mode."""
ATTRIBUTES: dict[str, tuple[int, ...]] = {"x86_64": (188, 189, 190, 463), "aarch64": (5, 6, 7, 463)}
"""`setxattr`, `lsetxattr`, `fsetxattr` and `setxattrat`, which set access control lists and capabilities too."""
