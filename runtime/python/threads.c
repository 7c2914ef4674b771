/* Threads for onespp_config.parallel_for, so that tasks of a frame never wait for Python. Without POSIX threads there is
 * no pool, and tasks run one after the other. */
#define _POSIX_C_SOURCE 200809L

#include "onespp.h"

typedef struct onespp_pool onespp_pool;

#if defined(__unix__) || defined(__APPLE__)

#include <pthread.h>
#include <stdlib.h>
#include <unistd.h>

struct onespp_pool {
    pthread_mutex_t lock;
    pthread_cond_t work, done;
    onespp_task task;
    void *argument;
    int count, next, finished, ends;
    pid_t owner;
    int workers; /* threads besides the caller's */
    pthread_t threads[];
};

/* A fork has the memory of the pool, but not its threads. */
static int is_forked(const onespp_pool *pool) { return getpid() != pool->owner; }

/* Takes tasks until none is left. The lock is held before and after. */
static void take_tasks(onespp_pool *pool)
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
    onespp_pool *pool = argument;
    pthread_mutex_lock(&pool->lock);
    while (!pool->ends) {
        take_tasks(pool);
        pthread_cond_wait(&pool->work, &pool->lock);
    }
    pthread_mutex_unlock(&pool->lock);
    return NULL;
}

void onespp_pool_destroy(onespp_pool *pool)
{
    if (!pool || is_forked(pool))
        return; /* in a fork, threads that do not exist can't be waited for */
    pthread_mutex_lock(&pool->lock);
    pool->ends = 1;
    pthread_cond_broadcast(&pool->work);
    pthread_mutex_unlock(&pool->lock);
    for (int i = 0; i < pool->workers; i++)
        pthread_join(pool->threads[i], NULL);
    pthread_cond_destroy(&pool->done);
    pthread_cond_destroy(&pool->work);
    pthread_mutex_destroy(&pool->lock);
    free(pool);
}

/* NULL where threads can't be started. */
onespp_pool *onespp_pool_create(int threads)
{
    size_t workers = threads > 1 ? (size_t)threads - 1 : 0;
    onespp_pool *pool = calloc(1, sizeof *pool + workers * sizeof *pool->threads);
    if (!pool)
        return NULL;
    pool->owner = getpid();
    pthread_mutex_init(&pool->lock, NULL);
    pthread_cond_init(&pool->work, NULL);
    pthread_cond_init(&pool->done, NULL);
    for (; pool->workers < (int)workers; pool->workers++)
        if (pthread_create(&pool->threads[pool->workers], NULL, worker, pool)) {
            onespp_pool_destroy(pool);
            return NULL;
        }
    return pool;
}

/* An onespp_parallel_for. */
void onespp_pool_run(void *user, int count, onespp_task task, void *argument)
{
    onespp_pool *pool = user;
    if (is_forked(pool)) {
        for (int i = 0; i < count; i++)
            task(argument, i);
        return;
    }
    pthread_mutex_lock(&pool->lock);
    pool->task = task;
    pool->argument = argument;
    pool->count = count;
    pool->next = pool->finished = 0;
    pthread_cond_broadcast(&pool->work);
    take_tasks(pool);
    while (pool->finished < count)
        pthread_cond_wait(&pool->done, &pool->lock);
    pthread_mutex_unlock(&pool->lock);
}

#else

onespp_pool *onespp_pool_create(int threads)
{
    (void)threads;
    return NULL;
}

void onespp_pool_destroy(onespp_pool *pool) { (void)pool; }

void onespp_pool_run(void *user, int count, onespp_task task, void *argument)
{
    (void)user;
    for (int i = 0; i < count; i++)
        task(argument, i);
}

#endif
