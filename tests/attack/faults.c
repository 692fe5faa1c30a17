/* Library preloaded before libc: at the n-th call that changes a file below a folder it kills the process, returns an
   error, or writes half of the data. The settings are on a page shared by all processes of a run (APERTURA_FAULTS is its
   file name), as is the count: the n-th write of a run is counted over all its processes. */
#define _GNU_SOURCE
#undef _FORTIFY_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <limits.h>
#include <signal.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <sys/uio.h>
#include <unistd.h>

enum { COUNT, KILL, FAIL, FAIL_ON, SHORT };                                          /* actions */
enum { WRITE = 1, RENAME = 2, FSYNC = 4, TRUNCATE = 8, MKDIR = 16, OPEN = 32, UNLINK = 64 }; /* kinds of calls */

struct page { /* same layout as `Page` in faults_control.py */
    long armed, action, error, kinds, at, count, struck;
    char folder[PATH_MAX];
};

static struct page *page;

__attribute__((constructor)) static void map_page(void) {
    const char *name = getenv("APERTURA_FAULTS");
    int file = name ? open(name, O_RDWR | O_CLOEXEC) : -1;
    if (file < 0) return;
    void *mapped = mmap(NULL, sizeof(struct page), PROT_READ | PROT_WRITE, MAP_SHARED, file, 0);
    if (mapped != MAP_FAILED) page = mapped;
    close(file);
}

static int below(const char *path) {
    size_t length = strlen(page->folder);
    return strncmp(path, page->folder, length) == 0 && (path[length] == '/' || path[length] == 0);
}

static int names(int folder, const char *path) {
    char whole[2 * PATH_MAX], link[64];
    if (path[0] == '/') return below(path);
    ssize_t length;
    if (folder == AT_FDCWD) {
        length = getcwd(whole, PATH_MAX) ? (ssize_t)strlen(whole) : -1;
    } else {
        snprintf(link, sizeof link, "/proc/self/fd/%d", folder);
        length = readlink(link, whole, PATH_MAX - 1);
    }
    if (length < 0) return 0;
    snprintf(whole + length, PATH_MAX, "/%s", path);
    return below(whole);
}

static int is_open_below(int file) {
    char link[64], path[PATH_MAX];
    snprintf(link, sizeof link, "/proc/self/fd/%d", file);
    ssize_t length = readlink(link, path, sizeof path - 1);
    if (length < 0) return 0;
    path[length] = 0;
    return below(path);
}

static int watched(int kind) { return page && page->armed && (page->kinds & kind); }

/* Count a call; return its action: 0 (none), FAIL or SHORT. */
static int struck(void) {
    long now = __atomic_add_fetch(&page->count, 1, __ATOMIC_SEQ_CST);
    if (page->action == COUNT || now < page->at || (now > page->at && page->action != FAIL_ON)) return 0;
    __atomic_add_fetch(&page->struck, 1, __ATOMIC_SEQ_CST);
    if (page->action == KILL) {
        kill(getpid(), SIGKILL);
        pause();
    }
    errno = (int)page->error;
    return page->action == SHORT ? SHORT : FAIL;
}

#define REAL(result, name, ...)                                        \
    static result (*real)(__VA_ARGS__);                                \
    if (!real) real = (result(*)(__VA_ARGS__))dlsym(RTLD_NEXT, #name);

ssize_t write(int file, const void *bytes, size_t size) {
    REAL(ssize_t, write, int, const void *, size_t)
    int what = watched(WRITE) && is_open_below(file) ? struck() : 0;
    return what == FAIL ? -1 : real(file, bytes, what == SHORT ? size / 2 : size);
}

#define PWRITE(name, offset_type)                                                              \
    ssize_t name(int file, const void *bytes, size_t size, offset_type at) {                   \
        REAL(ssize_t, name, int, const void *, size_t, offset_type)                            \
        int what = watched(WRITE) && is_open_below(file) ? struck() : 0;                       \
        return what == FAIL ? -1 : real(file, bytes, what == SHORT ? size / 2 : size, at);     \
    }
PWRITE(pwrite, off_t)
PWRITE(pwrite64, off64_t)

ssize_t writev(int file, const struct iovec *parts, int count) {
    REAL(ssize_t, writev, int, const struct iovec *, int)
    int what = watched(WRITE) && is_open_below(file) ? struck() : 0;
    return what == FAIL ? -1 : real(file, parts, what == SHORT ? (count + 1) / 2 : count);
}

size_t fwrite(const void *bytes, size_t size, size_t count, FILE *stream) {
    REAL(size_t, fwrite, const void *, size_t, size_t, FILE *)
    int what = watched(WRITE) && is_open_below(fileno(stream)) ? struck() : 0;
    return what == FAIL ? 0 : real(bytes, size, what == SHORT ? count / 2 : count, stream);
}

#define OF_FILE(name, kind, returned)                                    \
    int name returned {                                                  \
        REAL(int, name, int)                                             \
        return watched(kind) && is_open_below(file) && struck() ? -1 : real(file); \
    }
OF_FILE(fsync, FSYNC, (int file))
OF_FILE(fdatasync, FSYNC, (int file))

#define TRUNCATES(name, offset_type)                                                            \
    int name(int file, offset_type size) {                                                      \
        REAL(int, name, int, offset_type)                                                       \
        return watched(TRUNCATE) && is_open_below(file) && struck() ? -1 : real(file, size);    \
    }
TRUNCATES(ftruncate, off_t)
TRUNCATES(ftruncate64, off64_t)

#define OF_PATH(name, kind)                                                                     \
    int name(const char *path) {                                                                \
        REAL(int, name, const char *)                                                           \
        return watched(kind) && names(AT_FDCWD, path) && struck() ? -1 : real(path);            \
    }
OF_PATH(unlink, UNLINK)
OF_PATH(rmdir, UNLINK)

int unlinkat(int folder, const char *path, int flags) {
    REAL(int, unlinkat, int, const char *, int)
    return watched(UNLINK) && names(folder, path) && struck() ? -1 : real(folder, path, flags);
}

int mkdir(const char *path, mode_t mode) {
    REAL(int, mkdir, const char *, mode_t)
    return watched(MKDIR) && names(AT_FDCWD, path) && struck() ? -1 : real(path, mode);
}

int mkdirat(int folder, const char *path, mode_t mode) {
    REAL(int, mkdirat, int, const char *, mode_t)
    return watched(MKDIR) && names(folder, path) && struck() ? -1 : real(folder, path, mode);
}

#define OF_TWO_PATHS(name)                                                                      \
    int name(const char *from, const char *to) {                                                \
        REAL(int, name, const char *, const char *)                                             \
        return watched(RENAME) && names(AT_FDCWD, to) && struck() ? -1 : real(from, to);        \
    }
OF_TWO_PATHS(rename)
OF_TWO_PATHS(link)

int renameat(int folder, const char *from, int other, const char *to) {
    REAL(int, renameat, int, const char *, int, const char *)
    return watched(RENAME) && names(other, to) && struck() ? -1 : real(folder, from, other, to);
}

static int to_write(int flags) { return (flags & O_ACCMODE) != O_RDONLY || (flags & O_CREAT); }

static mode_t mode_of(int flags, va_list more) {
    return (flags & (O_CREAT | O_TMPFILE)) ? (mode_t)va_arg(more, int) : 0;
}

#define OPENS(name)                                                                             \
    int name(const char *path, int flags, ...) {                                                \
        REAL(int, name, const char *, int, ...)                                                 \
        va_list more;                                                                           \
        va_start(more, flags);                                                                  \
        mode_t mode = mode_of(flags, more);                                                     \
        va_end(more);                                                                           \
        if (to_write(flags) && watched(OPEN) && names(AT_FDCWD, path) && struck()) return -1;   \
        return real(path, flags, mode);                                                         \
    }
OPENS(open)
OPENS(open64)

#define OPENS_AT(name)                                                                          \
    int name(int folder, const char *path, int flags, ...) {                                    \
        REAL(int, name, int, const char *, int, ...)                                            \
        va_list more;                                                                           \
        va_start(more, flags);                                                                  \
        mode_t mode = mode_of(flags, more);                                                     \
        va_end(more);                                                                           \
        if (to_write(flags) && watched(OPEN) && names(folder, path) && struck()) return -1;     \
        return real(folder, path, flags, mode);                                                 \
    }
OPENS_AT(openat)
OPENS_AT(openat64)

#define FOPENS(name)                                                                            \
    FILE *name(const char *path, const char *mode) {                                            \
        REAL(FILE *, name, const char *, const char *)                                          \
        if (strpbrk(mode, "wa+") && watched(OPEN) && names(AT_FDCWD, path) && struck()) return NULL; \
        return real(path, mode);                                                                \
    }
FOPENS(fopen)
FOPENS(fopen64)
