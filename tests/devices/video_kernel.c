/* The kernel's side of the video interface, for a camera that is not there: preloaded into the program under
 * test, it answers the ioctls of /dev/null by the kernel's own header and hands memory out for its buffers.
 * What it is comes from the environment: VIDEO_FORMAT, VIDEO_PLANES (1: it delivers images in planes only).
 */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <linux/videodev2.h>
#include <stdarg.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <time.h>
#include <unistd.h>

enum { N_BUFFERS = 8, BEGIN = 1 << 20, STEP = 1 << 22, WIDTH = 64, HEIGHT = 48, STRIDE = 192, TAIL = 40 };
static unsigned char *memory[N_BUFFERS];
static int queued[N_BUFFERS], n_queued, is_streaming;
static unsigned sequence;

static unsigned code(void) { unsigned c; memcpy(&c, getenv("VIDEO_FORMAT"), 4); return c; }
static unsigned used(void) { return STRIDE * HEIGHT; }

static void paint(unsigned char *at) {
    memset(at, 255, used() + TAIL); /* what must not be seen */
    for (unsigned k = 0; k < used(); k++) {
        unsigned column = k % STRIDE, luma = 20 + column / 4 + sequence;
        at[k] = column % 2 ? luma : 128;
    }
}

static int answer(unsigned long request, void *arg) {
    unsigned type = V4L2_BUF_TYPE_VIDEO_CAPTURE, is_planar = atoi(getenv("VIDEO_PLANES"));
    switch (request) {
    case VIDIOC_QUERYCAP: {
        struct v4l2_capability *c = arg;
        strcpy((char *)c->driver, "stand-in"), strcpy((char *)c->card, "Stand-in");
        c->capabilities = V4L2_CAP_DEVICE_CAPS;
        c->device_caps = V4L2_CAP_STREAMING | (is_planar ? V4L2_CAP_VIDEO_CAPTURE_MPLANE : V4L2_CAP_VIDEO_CAPTURE);
        return 0; }
    case VIDIOC_ENUM_FMT: {
        struct v4l2_fmtdesc *f = arg;
        if (f->type != type || f->index) return EINVAL;
        f->pixelformat = code();
        return 0; }
    case VIDIOC_S_FMT: {
        struct v4l2_format *f = arg;
        if (f->type != type) return EINVAL;
        struct v4l2_pix_format *p = &f->fmt.pix;
        p->width = WIDTH, p->height = HEIGHT, p->pixelformat = code(), p->bytesperline = STRIDE;
        return 0; }
    case VIDIOC_REQBUFS: {
        struct v4l2_requestbuffers *r = arg;
        if (r->type != type) return EINVAL;
        if (r->count) r->count = N_BUFFERS;
        return 0; }
    case VIDIOC_QUERYBUF: case VIDIOC_QBUF: case VIDIOC_DQBUF: {
        struct v4l2_buffer *b = arg;
        if (b->type != type) return EINVAL;
        if (request == VIDIOC_QBUF) { queued[n_queued++] = b->index; return 0; }
        if (request == VIDIOC_DQBUF) {
            static struct timespec last;
            struct timespec now;
            clock_gettime(CLOCK_MONOTONIC, &now);
            long since_us = (now.tv_sec - last.tv_sec) * 1000000 + (now.tv_nsec - last.tv_nsec) / 1000;
            if (!is_streaming || !n_queued || (last.tv_sec && since_us < 20000)) return EAGAIN;
            last = now;
            b->index = queued[0];
            memmove(queued, queued + 1, --n_queued * sizeof *queued);
            paint(memory[b->index]);
            b->sequence = sequence++;
            b->flags = V4L2_BUF_FLAG_TIMESTAMP_MONOTONIC;
            b->timestamp.tv_sec = now.tv_sec, b->timestamp.tv_usec = now.tv_nsec / 1000;
        }
        b->length = used() + TAIL, b->bytesused = used(), b->m.offset = BEGIN + (long)b->index * STEP;
        return 0; }
    case VIDIOC_STREAMON: is_streaming = 1; return 0;
    case VIDIOC_STREAMOFF: is_streaming = 0, n_queued = 0; return 0;
    }
    return ENOTTY;
}

int ioctl(int fd, unsigned long request, ...) {
    va_list list;
    va_start(list, request);
    void *arg = va_arg(list, void *);
    va_end(list);
    if (((request >> 8) & 0xff) != 'V') return ((int (*)(int, unsigned long, ...))dlsym(RTLD_NEXT, "ioctl"))(fd, request, arg);
    int error = answer(request & 0xffffffffu, arg);
    if (error) errno = error;
    return error ? -1 : 0;
}

void *mmap64(void *where, size_t size, int protection, int flags, int fd, off64_t at) {
    int is_ours = fd >= 0 && (flags & MAP_SHARED) && at >= BEGIN && (at - BEGIN) % STEP == 0;
    int number = is_ours ? (at - BEGIN) / STEP : 0;
    if (!is_ours || number >= N_BUFFERS)
        return ((void *(*)(void *, size_t, int, int, int, off64_t))dlsym(RTLD_NEXT, "mmap64"))(where, size, protection, flags, fd, at);
    if (size != used() + TAIL) { errno = EINVAL; return MAP_FAILED; }
    void *given = ((void *(*)(void *, size_t, int, int, int, off64_t))dlsym(RTLD_NEXT, "mmap64"))(0, size, protection, MAP_SHARED | MAP_ANONYMOUS, -1, 0);
    memory[number] = given;
    return given;
}
void *mmap(void *where, size_t size, int protection, int flags, int fd, off_t at) { return mmap64(where, size, protection, flags, fd, at); }
