/* Loaded before libc (LD_PRELOAD): counts the calls that change files below a folder, and lets one
 * of them fail or kills the process instead of making it. Armed from Python through ctypes. */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <limits.h>
#include <signal.h>
#include <stdarg.h>
#include <stdatomic.h>
#include <stdio.h>
#include <string.h>
#include <sys/stat.h>
#include <sys/types.h>
#include <sys/uio.h>
#include <unistd.h>

static char folder[PATH_MAX];
static atomic_long count;
static long target = -1;
static int failure; /* an errno, or 0 to kill */
static int lasting; /* all later calls fail too, as on a full disk */

void arm(const char *path, long number, int error, int for_good) {
    snprintf(folder, sizeof folder, "%s", path);
    atomic_store(&count, 0);
    target = number;
    failure = error;
    lasting = for_good;
}

long counted(void) { return atomic_load(&count); }

static int strike(void) {
    long number = atomic_fetch_add(&count, 1);
    if (target < 0 || number < target || (number > target && !lasting)) return 0;
    if (failure == 0) kill(getpid(), SIGKILL);
    errno = failure;
    return 1;
}

static int below(const char *path) {
    return folder[0] && strncmp(path, folder, strlen(folder)) == 0;
}

static int below_fd(int fd) {
    char link[64], path[PATH_MAX];
    if (!folder[0]) return 0;
    int kept = errno;
    snprintf(link, sizeof link, "/proc/self/fd/%d", fd);
    ssize_t length = readlink(link, path, sizeof path - 1);
    errno = kept;
    if (length < 0) return 0;
    path[length] = 0;
    return below(path);
}

static int below_at(int fd, const char *path) {
    return path[0] == '/' ? below(path) : fd != AT_FDCWD && below_fd(fd);
}

static int changes(int flags) { return (flags & (O_WRONLY | O_RDWR | O_CREAT | O_TRUNC)) != 0; }

#define REAL(name) ((__typeof__(&name))dlsym(RTLD_NEXT, #name))
#define MODE(flags) \
    mode_t mode = 0; \
    if ((flags) & (O_CREAT | O_TMPFILE)) { \
        va_list list; \
        va_start(list, flags); \
        mode = va_arg(list, mode_t); \
        va_end(list); \
    }

int open(const char *path, int flags, ...) {
    MODE(flags)
    if (changes(flags) && below(path) && strike()) return -1;
    return REAL(open)(path, flags, mode);
}
int open64(const char *path, int flags, ...) {
    MODE(flags)
    if (changes(flags) && below(path) && strike()) return -1;
    return REAL(open64)(path, flags, mode);
}
int openat(int fd, const char *path, int flags, ...) {
    MODE(flags)
    if (changes(flags) && below_at(fd, path) && strike()) return -1;
    return REAL(openat)(fd, path, flags, mode);
}
int openat64(int fd, const char *path, int flags, ...) {
    MODE(flags)
    if (changes(flags) && below_at(fd, path) && strike()) return -1;
    return REAL(openat64)(fd, path, flags, mode);
}
FILE *fopen(const char *path, const char *mode) {
    if (strpbrk(mode, "wa+") && below(path) && strike()) return NULL;
    return REAL(fopen)(path, mode);
}
FILE *fopen64(const char *path, const char *mode) {
    if (strpbrk(mode, "wa+") && below(path) && strike()) return NULL;
    return REAL(fopen64)(path, mode);
}
ssize_t write(int fd, const void *data, size_t size) {
    if (below_fd(fd) && strike()) return -1;
    return REAL(write)(fd, data, size);
}
ssize_t writev(int fd, const struct iovec *parts, int number) {
    if (below_fd(fd) && strike()) return -1;
    return REAL(writev)(fd, parts, number);
}
int fsync(int fd) {
    if (below_fd(fd) && strike()) return -1;
    return REAL(fsync)(fd);
}
int rename(const char *from, const char *to) {
    if ((below(from) || below(to)) && strike()) return -1;
    return REAL(rename)(from, to);
}
int mkdir(const char *path, mode_t mode) {
    if (below(path) && strike()) return -1;
    return REAL(mkdir)(path, mode);
}
int unlink(const char *path) {
    if (below(path) && strike()) return -1;
    return REAL(unlink)(path);
}
int unlinkat(int fd, const char *path, int flags) {
    if (below_at(fd, path) && strike()) return -1;
    return REAL(unlinkat)(fd, path, flags);
}
int rmdir(const char *path) {
    if (below(path) && strike()) return -1;
    return REAL(rmdir)(path);
}
