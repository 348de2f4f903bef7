/* A library to preload: one call to the file system fails once, with a chosen error, as a full disk, a quota, a lack of
   descriptors or a defect lets it fail. Calls count that are for files below PLGS_FAIL_BELOW. The processes that share
   PLGS_FAIL_STATE count together; with PLGS_FAIL_ALONE, children are left out. tests/failing_calls/failing.py writes
   the state. */
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
#include <sys/uio.h>
#include <unistd.h>

struct state {
  int64_t count, at; /* calls so far; the one that fails, from 1; 0: none */
  int32_t error, failed;
  char what[512]; /* the call that failed */
};
static struct state *state;
static char below[PATH_MAX];
static int trace = -1; /* each call becomes a line of this file: "write name" */

#define REAL(name) ((__typeof__(&name))dlsym(RTLD_NEXT, #name))

__attribute__((constructor)) static void begin(void) {
  const char *path = getenv("PLGS_FAIL_STATE"), *folder = getenv("PLGS_FAIL_BELOW"), *traced = getenv("PLGS_FAIL_TRACE");
  if (!path || !folder) return;
  int file = REAL(open)(path, O_RDWR | O_CLOEXEC);
  if (file < 0) return;
  void *map = mmap(NULL, sizeof *state, PROT_READ | PROT_WRITE, MAP_SHARED, file, 0);
  close(file);
  if (map == MAP_FAILED) return;
  snprintf(below, sizeof below, "%s/", folder);
  if (traced) trace = REAL(open)(traced, O_WRONLY | O_APPEND | O_CREAT | O_CLOEXEC, 0600);
  if (getenv("PLGS_FAIL_ALONE")) unsetenv("LD_PRELOAD");
  state = map;
}

/* 1 if it is the turn of the call `name` on `path` to fail; errno is then set. */
static int fails(const char *name, const char *path) {
  if (!state || strncmp(path, below, strlen(below))) return 0;
  int before = errno;
  int64_t number = __atomic_add_fetch(&state->count, 1, __ATOMIC_SEQ_CST);
  if (trace >= 0) {
    char line[PATH_MAX + 32];
    int length = snprintf(line, sizeof line, "%s %s\n", name, path + strlen(below));
    ssize_t ignored = REAL(write)(trace, line, length < (int)sizeof line ? length : (int)sizeof line - 1);
    (void)ignored;
  }
  errno = before;
  if (number != state->at) return 0;
  snprintf(state->what, sizeof state->what, "%s %s", name, path + strlen(below));
  state->failed = 1;
  errno = state->error;
  return 1;
}

static int fails_at(const char *name, int folder, const char *path) {
  char whole[2 * PATH_MAX], link[64];
  if (!state || !path) return 0;
  if (path[0] == '/') return fails(name, path);
  if (folder == AT_FDCWD)
    strcpy(link, "/proc/self/cwd");
  else
    snprintf(link, sizeof link, "/proc/self/fd/%d", folder);
  ssize_t length = readlink(link, whole, PATH_MAX - 1);
  if (length < 0) return 0;
  snprintf(whole + length, PATH_MAX, "/%s", path);
  return fails(name, whole);
}

static int fails_on(const char *name, int file) {
  char path[PATH_MAX], link[64];
  if (!state) return 0;
  snprintf(link, sizeof link, "/proc/self/fd/%d", file);
  ssize_t length = readlink(link, path, sizeof path - 1);
  if (length < 0) return 0;
  path[length] = 0;
  return fails(name, path);
}

static int writes(FILE *file) { return (fcntl(fileno(file), F_GETFL) & O_ACCMODE) != O_RDONLY; }
static const char *opening(int flags) { return (flags & O_CREAT) ? "create" : "open"; }
static const char *mode_opening(const char *mode) { return (mode[0] == 'r') ? "open" : "create"; }

#define OPEN(name)                                            \
  int name(const char *path, int flags, ...) {                \
    va_list more;                                             \
    va_start(more, flags);                                    \
    mode_t mode = va_arg(more, int);                          \
    va_end(more);                                             \
    if (fails_at(opening(flags), AT_FDCWD, path)) return -1;  \
    return REAL(name)(path, flags, mode);                     \
  }
OPEN(open)
OPEN(open64)

#define OPENAT(name)                                          \
  int name(int folder, const char *path, int flags, ...) {    \
    va_list more;                                             \
    va_start(more, flags);                                    \
    mode_t mode = va_arg(more, int);                          \
    va_end(more);                                             \
    if (fails_at(opening(flags), folder, path)) return -1;    \
    return REAL(name)(folder, path, flags, mode);             \
  }
OPENAT(openat)
OPENAT(openat64)

#define FOPEN(name)                                                     \
  FILE *name(const char *path, const char *mode) {                      \
    if (fails_at(mode_opening(mode), AT_FDCWD, path)) return NULL;      \
    return REAL(name)(path, mode);                                      \
  }
FOPEN(fopen)
FOPEN(fopen64)

ssize_t write(int file, const void *data, size_t size) {
  return fails_on("write", file) ? -1 : REAL(write)(file, data, size);
}
ssize_t pwrite(int file, const void *data, size_t size, off_t at) {
  return fails_on("write", file) ? -1 : REAL(pwrite)(file, data, size, at);
}
ssize_t pwrite64(int file, const void *data, size_t size, off64_t at) {
  return fails_on("write", file) ? -1 : REAL(pwrite64)(file, data, size, at);
}
ssize_t writev(int file, const struct iovec *parts, int count) {
  return fails_on("write", file) ? -1 : REAL(writev)(file, parts, count);
}
/* The C library's own writing cannot be replaced, so a stream fails where it is given data, or where it is closed: what
   it still held is then lost. */
size_t fwrite(const void *data, size_t size, size_t count, FILE *file) {
  return fileno(file) > 2 && fails_on("write", fileno(file)) ? 0 : REAL(fwrite)(data, size, count, file);
}
int fclose(FILE *file) {
  if (!state || fileno(file) < 3 || !writes(file) || !fails_on("write", fileno(file))) return REAL(fclose)(file);
  int copy = dup(fileno(file)), error = errno;
  off_t written = lseek(copy, 0, SEEK_CUR);
  REAL(fclose)(file);
  int ignored = ftruncate(copy, written);
  (void)ignored;
  close(copy);
  errno = error;
  return EOF;
}

int fsync(int file) { return fails_on("fsync", file) ? -1 : REAL(fsync)(file); }
int fdatasync(int file) { return fails_on("fsync", file) ? -1 : REAL(fdatasync)(file); }
int rename(const char *from, const char *to) {
  return fails_at("rename", AT_FDCWD, to) ? -1 : REAL(rename)(from, to);
}
int renameat(int from_folder, const char *from, int folder, const char *to) {
  return fails_at("rename", folder, to) ? -1 : REAL(renameat)(from_folder, from, folder, to);
}
int link(const char *from, const char *to) { return fails_at("link", AT_FDCWD, to) ? -1 : REAL(link)(from, to); }
int linkat(int from_folder, const char *from, int folder, const char *to, int flags) {
  return fails_at("link", folder, to) ? -1 : REAL(linkat)(from_folder, from, folder, to, flags);
}
int mkdir(const char *path, mode_t mode) { return fails_at("mkdir", AT_FDCWD, path) ? -1 : REAL(mkdir)(path, mode); }
