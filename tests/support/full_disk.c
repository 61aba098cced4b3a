/* A disk that is full while the file named by FULL_DISK_WHILE exists: preloaded into the service under test, it makes every write that
 * would take space in a regular file fail with ENOSPC. Reading, renaming and removing go on, as they do on a full disk. */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <stdlib.h>
#include <sys/stat.h>
#include <sys/uio.h>
#include <unistd.h>

static int full(int file)
{
    const char *flag = getenv("FULL_DISK_WHILE");
    struct stat status;
    int before = errno, is_full;

    is_full = flag && access(flag, F_OK) == 0 && fstat(file, &status) == 0 && S_ISREG(status.st_mode);
    errno = is_full ? ENOSPC : before;
    return is_full;
}

#define REAL(name) ((__typeof__(&name))dlsym(RTLD_NEXT, #name))

ssize_t write(int file, const void *bytes, size_t count)
{
    return full(file) ? -1 : REAL(write)(file, bytes, count);
}
ssize_t writev(int file, const struct iovec *parts, int count)
{
    return full(file) ? -1 : REAL(writev)(file, parts, count);
}
ssize_t pwrite(int file, const void *bytes, size_t count, off_t at)
{
    return full(file) ? -1 : REAL(pwrite)(file, bytes, count, at);
}
ssize_t pwrite64(int file, const void *bytes, size_t count, off64_t at)
{
    return full(file) ? -1 : REAL(pwrite64)(file, bytes, count, at);
}
int ftruncate(int file, off_t length)
{
    return full(file) ? -1 : REAL(ftruncate)(file, length);
}
int ftruncate64(int file, off64_t length)
{
    return full(file) ? -1 : REAL(ftruncate64)(file, length);
}
ssize_t copy_file_range(int from, off64_t *from_at, int to, off64_t *to_at, size_t count, unsigned flags)
{
    return full(to) ? -1 : REAL(copy_file_range)(from, from_at, to, to_at, count, flags);
}
