/* Denoises a raw sequence: example SEQUENCE OUTPUT [THREADS [MAX_ISA]]
 *
 * SEQUENCE is what `python -m runtime.raw` writes, see raw.h. OUTPUT becomes the denoised frames as planes of float32,
 * three per frame. MAX_ISA is that of onespp_config. Prints the instruction set, and the time that each frame took.
 */
#define _POSIX_C_SOURCE 200809L

#include "raw.h"

#include <pthread.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

enum { MAX_MESHES = 4096, MAX_THREADS = 64 };

/* --- Threads that wait for tasks ---------------------------------------------------------------------------------- */

typedef struct {
    pthread_mutex_t lock;
    pthread_cond_t work, done;
    onespp_task task;
    void *argument;
    int count, next, finished;
} Pool;

/* Takes tasks until none is left. The lock is held before and after. */
static void take_tasks(Pool *pool)
{
    while (pool->next < pool->count) {
        int index = pool->next++;
        pthread_mutex_unlock(&pool->lock);
        pool->task(pool->argument, index);
        pthread_mutex_lock(&pool->lock);
        if (++pool->finished == pool->count)
            pthread_cond_signal(&pool->done);
    }
}

static void *worker(void *argument)
{
    Pool *pool = argument;
    pthread_mutex_lock(&pool->lock);
    for (;;) {
        take_tasks(pool);
        pthread_cond_wait(&pool->work, &pool->lock);
    }
    return NULL;
}

static void parallel_for(void *user, int count, onespp_task task, void *argument)
{
    Pool *pool = user;
    pthread_mutex_lock(&pool->lock);
    pool->task = task;
    pool->argument = argument;
    pool->count = count;
    pool->next = pool->finished = 0;
    pthread_cond_broadcast(&pool->work);
    take_tasks(pool);
    while (pool->finished < pool->count)
        pthread_cond_wait(&pool->done, &pool->lock);
    pthread_mutex_unlock(&pool->lock);
}

/* --- Frames ------------------------------------------------------------------------------------------------------- */

/* 1 if there is another frame, which then replaces the one in memory, 0 at the end, -1 where the file is damaged. */
static int read_frame(FILE *file, raw_header **raw)
{
    raw_header header;
    size_t bytes = fread(&header, 1, sizeof header, file);
    if (bytes != sizeof header)
        return bytes || ferror(file) ? -1 : 0;
    if (header.width < 1 || header.width > ONESPP_MAX_SIDE || header.height < 1 || header.height > ONESPP_MAX_SIDE
        || header.meshes < 0 || header.meshes > MAX_MESHES)
        return -1;
    size_t size = raw_size(&header);
    *raw = realloc(*raw, size);
    if (!*raw)
        return -1;
    **raw = header;
    return fread(*raw + 1, size - sizeof header, 1, file) == 1 ? 1 : -1;
}

static double seconds(void)
{
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return (double)now.tv_sec + 1e-9 * (double)now.tv_nsec;
}

static int fail(const char *message)
{
    fprintf(stderr, "%s\n", message);
    return EXIT_FAILURE;
}

int main(int count, char **arguments)
{
    int threads = count > 3 ? atoi(arguments[3]) : 2;
    int max_isa = count > 4 ? atoi(arguments[4]) : ONESPP_ISA_ANY;
    FILE *file = count > 2 ? fopen(arguments[1], "rb") : NULL;
    raw_header *raw = NULL;
    if (!file || threads < 1 || threads > MAX_THREADS)
        return fail("usage: example SEQUENCE OUTPUT [THREADS [MAX_ISA]]");
    if (strcmp(arguments[1], arguments[2]) == 0)
        return fail("the output would overwrite the sequence: name another file");
    int found = read_frame(file, &raw);
    if (found != 1)
        return fail("there is no whole frame");
    FILE *out = fopen(arguments[2], "wb"); /* not before: an earlier output stays where there is no frame */
    if (!out)
        return fail("the output could not be written");

    static Pool pool = {PTHREAD_MUTEX_INITIALIZER, PTHREAD_COND_INITIALIZER, PTHREAD_COND_INITIALIZER, 0, 0, 0, 0, 0};
    pthread_t thread;
    for (int i = 1; i < threads; i++)
        if (pthread_create(&thread, NULL, worker, &pool))
            return fail("a thread could not be started");

    /* All frames are as large as the first one, or smaller. Twice as many tasks as threads even out their work. */
    onespp_config config = {.abi = ONESPP_ABI, .max_width = raw->width, .max_height = raw->height, .max_isa = max_isa,
                            .max_meshes = MAX_MESHES, .tasks = 2 * threads, .parallel_for = parallel_for, .user = &pool};
    size_t size = onespp_size(&config), pixels = (size_t)raw->width * (size_t)raw->height;
    void *memory = malloc(size);
    float *radiance = malloc(sizeof(float) * 3 * pixels);
    onespp *denoiser;
    int error = onespp_create(&config, memory, size, &denoiser);
    if (error || !radiance)
        return fail(error ? onespp_message(error) : "out of memory");
    static const char *const names[] = {
        [ONESPP_ISA_BASELINE] = "baseline", [ONESPP_ISA_AVX2] = "AVX2", [ONESPP_ISA_AVX512] = "AVX-512"};
    printf("%s\n", names[onespp_isa(denoiser)]);
    do {
        onespp_frame frame = raw_frame(raw);
        onespp_output output = {radiance, (ptrdiff_t)frame.width * frame.height, frame.width, 1};
        double start = seconds();
        error = onespp_denoise(denoiser, &frame, &output);
        if (error)
            return fail(onespp_message(error));
        printf("%.1f ms\n", 1e3 * (seconds() - start));
        pixels = (size_t)frame.width * (size_t)frame.height;
        if (fwrite(radiance, sizeof(float), 3 * pixels, out) != 3 * pixels)
            return fail("the output could not be written");
        found = read_frame(file, &raw);
    } while (found == 1);
    if (found)
        return fail("the sequence is damaged: the frames before are written");
    return fclose(out) ? fail("the output could not be written") : EXIT_SUCCESS;
}
