/* Preloaded into a process, makes the disk below each folder of $BAD_DISK_FOLDERS (with colons between them) bad as the file
   $BAD_DISK says: for each folder two 32-bit integers, the error with which changes end (EROFS, EDQUOT, EIO; 0: none) and the
   milliseconds that each fsync takes longer. */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <limits.h>
#include <stdarg.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <sys/syscall.h>
#include <sys/types.h>
#include <time.h>
#include <unistd.h>

#define FOLDERS 2
static volatile struct { int32_t error, fsync_ms; } *disks;
static char folders[FOLDERS][PATH_MAX];

__attribute__((constructor)) static void find_disks(void) {
    const char *path = getenv("BAD_DISK"), *list = getenv("BAD_DISK_FOLDERS");
    int fd = path == NULL || list == NULL ? -1 : open(path, O_RDONLY | O_CLOEXEC);
    if (fd < 0) return;
    void *page = mmap(NULL, FOLDERS * sizeof *disks, PROT_READ, MAP_SHARED, fd, 0);
    close(fd);
    if (page == MAP_FAILED) return;
    char *copy = strdup(list), *rest = copy;
    for (int k = 0; k < FOLDERS && rest != NULL; k++) strncpy(folders[k], strsep(&rest, ":"), PATH_MAX - 1);
    free(copy);
    disks = page;
}

static int quiet(void) {
    if (disks == NULL) return 1;
    for (int k = 0; k < FOLDERS; k++)
        if (disks[k].error || disks[k].fsync_ms) return 0;
    return 1;
}

/* The folder's number, -1 for none. `path` NULL: the file that is open as `fd`; else it is below `fd`, as for openat. */
static int disk_of(int fd, const char *path) {
    char whole[2 * PATH_MAX] = "", name[64];
    if (quiet()) return -1;
    if (path == NULL || path[0] != '/') {
        if (fd == AT_FDCWD) snprintf(name, sizeof name, "/proc/self/cwd");
        else snprintf(name, sizeof name, "/proc/self/fd/%d", fd);
        ssize_t n = readlink(name, whole, PATH_MAX - 1);
        if (n < 0) return -1;
        whole[n] = 0;
    }
    if (path != NULL) {
        strcat(whole, path[0] == '/' ? "" : "/");
        strncat(whole, path, PATH_MAX - 1);
    }
    for (int k = 0; k < FOLDERS; k++) {
        size_t n = strlen(folders[k]);
        if (n && !strncmp(whole, folders[k], n) && (whole[n] == '/' || whole[n] == 0)) return k;
    }
    return -1;
}

static int refused(int fd, const char *path) {
    int saved = errno, k = disk_of(fd, path);
    errno = saved;
    if (k < 0 || !disks[k].error) return 0;
    errno = disks[k].error;
    return 1;
}

static void linger(int fd) {
    int k = disk_of(fd, NULL);
    if (k < 0 || !disks[k].fsync_ms) return;
    struct timespec pause = {disks[k].fsync_ms / 1000, disks[k].fsync_ms % 1000 * 1000000L};
    nanosleep(&pause, NULL);
}

#define REAL(name) ((__typeof__(&name))dlsym(RTLD_NEXT, #name))
#define GUARDED(type, name, parameters, arguments, fd, path) \
    type name parameters { return refused(fd, path) ? -1 : REAL(name) arguments; }

GUARDED(ssize_t, write, (int fd, const void *data, size_t n), (fd, data, n), fd, NULL)
GUARDED(ssize_t, pwrite, (int fd, const void *data, size_t n, off_t at), (fd, data, n, at), fd, NULL)
GUARDED(ssize_t, pwrite64, (int fd, const void *data, size_t n, off64_t at), (fd, data, n, at), fd, NULL)
GUARDED(int, ftruncate, (int fd, off_t n), (fd, n), fd, NULL)
GUARDED(int, ftruncate64, (int fd, off64_t n), (fd, n), fd, NULL)
GUARDED(int, mkdir, (const char *path, mode_t mode), (path, mode), AT_FDCWD, path)
GUARDED(int, mkdirat, (int fd, const char *path, mode_t mode), (fd, path, mode), fd, path)
GUARDED(int, rename, (const char *from, const char *to), (from, to), AT_FDCWD, to)
GUARDED(int, renameat, (int one, const char *from, int fd, const char *to), (one, from, fd, to), fd, to)
GUARDED(int, link, (const char *from, const char *to), (from, to), AT_FDCWD, to)
GUARDED(int, symlink, (const char *from, const char *to), (from, to), AT_FDCWD, to)

static int spared(int fd, const char *path) {
    int saved = errno, k = disk_of(fd, path), error = k < 0 ? 0 : disks[k].error;
    errno = saved;
    if (error != EROFS && error != EIO) return 1; /* who is over quota may still remove files */
    errno = error;
    return 0;
}

int unlink(const char *path) { return spared(AT_FDCWD, path) ? REAL(unlink)(path) : -1; }
int unlinkat(int fd, const char *path, int flags) { return spared(fd, path) ? REAL(unlinkat)(fd, path, flags) : -1; }
int rmdir(const char *path) { return spared(AT_FDCWD, path) ? REAL(rmdir)(path) : -1; }

int fsync(int fd) {
    linger(fd);
    return spared(fd, NULL) ? REAL(fsync)(fd) : -1;
}

int fdatasync(int fd) {
    linger(fd);
    return spared(fd, NULL) ? REAL(fdatasync)(fd) : -1;
}

static int opened(int fd, const char *path, int flags, mode_t mode) {
    int exists = faccessat(fd, path, F_OK, 0) == 0, changes = (flags & O_ACCMODE) != O_RDONLY;
    int k = disk_of(fd, path), error = k < 0 ? 0 : disks[k].error;
    if (error && ((error == EROFS && changes) || ((flags & O_CREAT) && !exists))) {
        errno = error;
        return -1;
    }
    return (int)syscall(SYS_openat, fd, path, flags | O_LARGEFILE, mode);
}

#define MODE(flags, mode) \
    mode_t mode = 0; \
    if ((flags) & (O_CREAT | __O_TMPFILE)) { va_list rest; va_start(rest, flags); mode = va_arg(rest, mode_t); va_end(rest); }

int open(const char *path, int flags, ...) { MODE(flags, mode) return opened(AT_FDCWD, path, flags, mode); }
int open64(const char *path, int flags, ...) { MODE(flags, mode) return opened(AT_FDCWD, path, flags, mode); }
int openat(int fd, const char *path, int flags, ...) { MODE(flags, mode) return opened(fd, path, flags, mode); }
int openat64(int fd, const char *path, int flags, ...) { MODE(flags, mode) return opened(fd, path, flags, mode); }
