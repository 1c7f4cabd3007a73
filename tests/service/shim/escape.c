/* A "libonnxruntime" that tries to leave the process of a network. Each attempt prints a line: its name, and
   `refused` or `done`. */

#define _GNU_SOURCE
#include <errno.h>
#include <fcntl.h>
#include <linux/io_uring.h>
#include <pthread.h>
#include <sched.h>
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/ipc.h>
#include <sys/mman.h>
#include <sys/prctl.h>
#include <sys/resource.h>
#include <sys/shm.h>
#include <sys/socket.h>
#include <sys/syscall.h>
#include <sys/wait.h>
#include <unistd.h>

static void report(const char *name, long result) {
    printf("%s %s\n", name, result < 0 ? "refused" : "done");
    fflush(stdout);
}

static void *idle(void *argument) { return argument; }

__attribute__((constructor)) static void escape(void) {
    const char *text = getenv("ESCAPE_TARGET");
    if (!text) return;
    int other = atoi(text);
    siginfo_t info;
    memset(&info, 0, sizeof info);
    info.si_signo = SIGCONT;
    info.si_code = SI_QUEUE;
    struct rlimit limit = {1, 1};
    struct io_uring_params ring;
    memset(&ring, 0, sizeof ring);

    /* More memory than the limit of 512 MiB, before an attempt lowers the limit. */
    const size_t gib = 1UL << 30;
    const int flags = MAP_PRIVATE | MAP_ANONYMOUS | MAP_NORESERVE;
    void *large = mmap(NULL, gib, PROT_READ | PROT_WRITE, flags, -1, 0);
    report("memory_over_limit", large == MAP_FAILED ? -1 : 0);
    void *hidden = mmap(NULL, gib, PROT_NONE, flags, -1, 0);
    report("memory_by_mprotect",
           hidden == MAP_FAILED ? -1 : mprotect(hidden, gib, PROT_READ | PROT_WRITE));
    report("memory_by_brk", sbrk(gib) == (void *)-1 ? -1 : 0);
    report("kill", kill(other, 0));
    report("tkill", syscall(SYS_tkill, other, 0));
    report("tgkill", syscall(SYS_tgkill, other, other, 0));
    report("rt_sigqueueinfo", syscall(SYS_rt_sigqueueinfo, other, SIGCONT, &info));
    report("rt_tgsigqueueinfo", syscall(SYS_rt_tgsigqueueinfo, other, other, SIGCONT, &info));
    report("pidfd_open", syscall(SYS_pidfd_open, other, 0));
    report("fcntl_setown", fcntl(0, F_SETOWN, other));
    report("prlimit64", syscall(SYS_prlimit64, other, RLIMIT_CORE, &limit, NULL));
    report("setrlimit", setrlimit(RLIMIT_DATA, &limit));
    report("setpriority", setpriority(PRIO_PROCESS, other, getpriority(PRIO_PROCESS, other)));
    report("sched_setaffinity", syscall(SYS_sched_setaffinity, other, 0, NULL));
    report("socket", socket(AF_INET, SOCK_STREAM, 0));
    report("io_uring_setup", syscall(SYS_io_uring_setup, 4, &ring));
    report("unshare", unshare(CLONE_NEWUSER));
    report("ptrace", syscall(SYS_ptrace, 16, other, NULL, NULL));
    report("shmget", shmget(IPC_PRIVATE, 4096, IPC_CREAT | 0600));
    report("shm_open", open("/dev/shm/sci-recon-escape", O_RDWR | O_CREAT, 0600));
    report("memfd_create", syscall(SYS_memfd_create, "escape", 0));
    void *shared = mmap(NULL, 4096, PROT_READ | PROT_WRITE, MAP_SHARED | MAP_ANONYMOUS, -1, 0);
    report("mmap_shared", shared == MAP_FAILED ? -1 : 0);
    report("write_file", open("/tmp/sci-recon-escape", O_WRONLY | O_CREAT, 0600));
    report("read_passwords", open("/etc/passwd", O_RDONLY));
    pid_t child = fork();
    if (child == 0) _exit(0);
    if (child > 0) waitpid(child, NULL, 0);
    report("fork", child);
    report("clone3", syscall(SYS_clone3, NULL, 0));
    char *const arguments[] = {"/bin/true", NULL};
    report("execve", execve("/bin/true", arguments, NULL));

    /* What computing needs must still work. */
    void *memory = mmap(NULL, 1 << 20, PROT_READ | PROT_WRITE, MAP_PRIVATE | MAP_ANONYMOUS, -1, 0);
    report("need_memory", memory == MAP_FAILED ? -1 : 0);
    report("need_file", open("/proc/self/status", O_RDONLY));
    pthread_t thread;
    report("need_thread", -pthread_create(&thread, NULL, idle, NULL));
    exit(0);
}
