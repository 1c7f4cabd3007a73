/* Causes faults on request of a test, by interposing (LD_PRELOAD) between a program and the C library.
 *
 * FAULT_PROGRAM  first argument of the affected programs: serve or worker
 * FAULT_AT       number of the file operation with the fault, from 1
 * FAULT_KIND     kill: the process dies before the operation; stop: it is suspended; full: this and the
 *                next writes of the process fail with ENOSPC
 * FAULT_TOKEN    a file of one byte; only the process that sets it to 1 has the fault
 * FAULT_FULL     a file; while it exists, all writes fail with ENOSPC
 * FAULT_READONLY a file; while it exists, all writes fail with EROFS
 * FAULT_SLOW     a file; while it exists, regular files are read at FAULT_RATE bytes per second
 * FAULT_CLOCK    a file of 8 bytes with the offset of the wall clock in seconds
 */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <pthread.h>
#include <signal.h>
#include <stdatomic.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <sys/types.h>
#include <time.h>
#include <unistd.h>

static long at = -1;
static int kind_full, kind_stop, failing;
static atomic_long count;
static const char *full, *readonly, *slow;
static double rate = 1e6;
static volatile char *token;
static volatile long long *skew;

static int is_affected(const char *program) {
    char line[256] = {0};
    int file = open("/proc/self/cmdline", O_RDONLY);
    if (file < 0) return 0;
    ssize_t length = pread(file, line, sizeof line - 1, 0);
    close(file);
    size_t first = strlen(line) + 1;
    return length > (ssize_t)first && strcmp(line + first, program) == 0;
}

__attribute__((constructor)) static void begin(void) {
    const char *program = getenv("FAULT_PROGRAM"), *number = getenv("FAULT_AT");
    const char *kind = getenv("FAULT_KIND"), *clock = getenv("FAULT_CLOCK");
    if (getenv("FAULT_TOKEN")) {
        /* Open the file now, because the program may drop the right to open it later. */
        int file = open(getenv("FAULT_TOKEN"), O_RDWR);
        void *page = mmap(NULL, 1, PROT_READ | PROT_WRITE, MAP_SHARED, file, 0);
        if (page != MAP_FAILED) token = page;
        close(file);
    }
    full = getenv("FAULT_FULL");
    readonly = getenv("FAULT_READONLY");
    slow = getenv("FAULT_SLOW");
    if (getenv("FAULT_RATE")) rate = atof(getenv("FAULT_RATE"));
    kind_full = kind && strcmp(kind, "full") == 0;
    kind_stop = kind && strcmp(kind, "stop") == 0;
    if (number && program && is_affected(program)) at = atol(number);
    if (clock) {
        int file = open(clock, O_RDONLY);
        void *page = mmap(NULL, 8, PROT_READ, MAP_SHARED, file, 0);
        if (page != MAP_FAILED) skew = page;
        close(file);
    }
}

static int regular(int file) {
    struct stat about;
    return fstat(file, &about) == 0 && S_ISREG(about.st_mode);
}

/* The error with which this operation must fail, or 0. */
static int fault(int writes) {
    if (writes && full && access(full, F_OK) == 0) return ENOSPC;
    if (writes && readonly && access(readonly, F_OK) == 0) return EROFS;
    if (at < 0) return 0;
    long now = atomic_fetch_add(&count, 1) + 1;
    if (now == at && token && __sync_bool_compare_and_swap(token, 0, 1)) {
        if (!kind_full) kill(getpid(), kind_stop ? SIGSTOP : SIGKILL);
        failing = kind_full;
    }
    return failing && now < at + 8 && writes ? ENOSPC : 0;
}

#define REAL(name) __typeof__(&name) real = (__typeof__(&name))dlsym(RTLD_NEXT, #name)
#define FAIL_IF(error) do { int number = (error); if (number) { errno = number; return -1; } } while (0)

ssize_t read(int file, void *bytes, size_t size) {
    REAL(read);
    ssize_t count = real(file, bytes, size);
    if (count > 0 && slow && access(slow, F_OK) == 0 && regular(file)) {
        double seconds = (double)count / rate;
        struct timespec pause = {(time_t)seconds, (long)((seconds - (time_t)seconds) * 1e9)};
        nanosleep(&pause, NULL);
    }
    return count;
}
ssize_t write(int file, const void *bytes, size_t size) {
    REAL(write);
    FAIL_IF(regular(file) ? fault(1) : 0);
    return real(file, bytes, size);
}
ssize_t pwrite64(int file, const void *bytes, size_t size, off64_t offset) {
    REAL(pwrite64);
    FAIL_IF(regular(file) ? fault(1) : 0);
    return real(file, bytes, size, offset);
}
ssize_t pwrite(int file, const void *bytes, size_t size, off_t offset) {
    return pwrite64(file, bytes, size, offset);
}
int fsync(int file) {
    REAL(fsync);
    FAIL_IF(fault(1));
    return real(file);
}
int fdatasync(int file) {
    REAL(fdatasync);
    FAIL_IF(fault(1));
    return real(file);
}
int rename(const char *from, const char *to) {
    REAL(rename);
    FAIL_IF(fault(1));
    return real(from, to);
}
int mkdir(const char *path, mode_t mode) {
    REAL(mkdir);
    FAIL_IF(fault(1));
    return real(path, mode);
}
int link(const char *from, const char *to) {
    REAL(link);
    FAIL_IF(fault(1));
    return real(from, to);
}
int linkat(int from_folder, const char *from, int to_folder, const char *to, int flags) {
    REAL(linkat);
    FAIL_IF(fault(1));
    return real(from_folder, from, to_folder, to, flags);
}
int unlink(const char *path) {
    REAL(unlink);
    fault(0);
    return real(path);
}
int unlinkat(int folder, const char *path, int flags) {
    REAL(unlinkat);
    fault(0);
    return real(folder, path, flags);
}
int clock_gettime(clockid_t clock, struct timespec *now) {
    REAL(clock_gettime);
    int result = real(clock, now);
    if (clock == CLOCK_REALTIME && skew) now->tv_sec += *skew;
    return result;
}
