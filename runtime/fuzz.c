/* Random frames for sanitizers: sizes from 1 x 1, NaN, infinities, ids out of range, motion of 1e30.
 *
 * With -fsanitize=fuzzer the fuzzer chooses the bytes that frames are made of; else `fuzz N` plays N random sequences.
 * Whatever comes in, the output has to be finite, and the same for any number of tasks.
 */
#include "onespp.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

enum { SIDE = 110, MOST_PIXELS = 1500, MESHES = 3, PLANES = 19, FRAMES = 3, PARTS = 2, OUTPUTS = 3 * (1 + PARTS) };

static const float EXTREMES[] = {0,     -0.f,   1,     -1,    NAN,    INFINITY, -INFINITY, 1e30f, -1e30f,
                                 3e38f, -3e38f, 1e35f, 1e16f, 1e-20f, 1e-38f,   1e-45f,    0.01f};

typedef struct {
    const uint8_t *bytes;
    size_t count, next;
    uint64_t state; /* random numbers follow where the bytes end */
} Source;

static uint32_t draw(Source *source, uint32_t below)
{
    source->state = source->state * 6364136223846793005u + 1442695040888963407u;
    uint32_t byte = source->next < source->count ? source->bytes[source->next++] : 0;
    return ((uint32_t)(source->state >> 33) ^ (byte * 2654435761u >> 4)) % below;
}

/* Usually in [low, low + 1], sometimes anything. */
static float number(Source *source, float low, uint32_t sanity)
{
    uint32_t extremes = sizeof EXTREMES / sizeof *EXTREMES;
    return draw(source, sanity) ? low + (float)draw(source, 1000) / 999 : EXTREMES[draw(source, extremes)];
}

static void fill_pose(Source *source, double pose[16])
{
    for (int i = 0; i < 16; i++)
        pose[i] = i % 5 == 0;
    for (int i = 0; i < 3; i++)
        pose[4 * i + 3] = draw(source, 4) ? 0.01 * draw(source, 10) : (double)number(source, 0, 2);
}

static onespp_image image(const float *planes, int first, int interleaved, int width, int height, int channels)
{
    ptrdiff_t size = (ptrdiff_t)width * height;
    onespp_image planar = {planes + first * size, size, width, 1};
    onespp_image mixed = {planes + first * size, 1, (ptrdiff_t)width * channels, channels};
    return interleaved ? mixed : planar;
}

/* A frame; which images are missing, and how others lie in memory, is random. */
static onespp_frame frame_of(Source *source, float *planes, int32_t *ids, double *poses)
{
    static const float lows[PLANES] = {[9] = 0, [12] = -0.5f, [13] = -0.5f, [14] = -1, [15] = 1, [17] = -0.5f};
    int width = 1 + (int)draw(source, SIDE), interleaved = (int)draw(source, 2);
    int most = MOST_PIXELS / width < SIDE ? MOST_PIXELS / width : SIDE, height = 1 + (int)draw(source, (uint32_t)most);
    uint32_t sanity = draw(source, 2) ? 3 : 1000;
    size_t pixels = (size_t)width * (size_t)height;
    onespp_frame frame = {.width = width, .height = height, .reset = draw(source, 5) == 0};
    for (size_t i = 0; i < PLANES * pixels; i++)
        planes[i] = number(source, lows[i / pixels], sanity);
    for (size_t i = 0; i < pixels; i++)
        ids[i] = draw(source, sanity) ? (int32_t)(i / 40 % 4) : (int32_t)(draw(source, 0x7fffffff) - 0x3fffffff) * 2;
    frame.samples = number(source, 1, 20);
    frame.direct = image(planes, 0, interleaved, width, height, 3);
    frame.indirect = image(planes, 3, interleaved, width, height, 3);
    frame.emission = image(planes, 6, interleaved, width, height, 3);
    frame.albedo = image(planes, 9, interleaved, width, height, 3);
    frame.normal = image(planes, 12, interleaved, width, height, 3);
    frame.depth = image(planes, 15, interleaved, width, height, 1);
    frame.roughness = image(planes, 16, interleaved, width, height, 1);
    frame.motion = image(planes, 17, interleaved, width, height, 2);
    onespp_ids mesh_id = {ids, width, 1};
    frame.mesh_id = mesh_id;
    if (draw(source, 3) == 0)
        frame.indirect.data = frame.emission.data = frame.roughness.data = NULL;
    if (draw(source, 3) == 0)
        frame.mesh_id.data = NULL;
    frame.K[0] = frame.K[4] = draw(source, 9) ? -30 : (double)number(source, 0, 2);
    frame.K[2] = 0.5 * width;
    frame.K[5] = 0.5 * height;
    fill_pose(source, frame.camera_to_world);
    frame.meshes = (int)draw(source, MESHES + 1);
    for (int i = 0; i < frame.meshes; i++)
        fill_pose(source, poses + 16 * i);
    frame.object_to_world = poses;
    frame.parts = (int)draw(source, PARTS + 1);
    frame.masks = (int)draw(source, (uint32_t)frame.parts + 1);
    return frame;
}

static void *allocated(size_t size)
{
    void *memory = malloc(size);
    if (!memory)
        abort();
    return memory;
}

static onespp_config config_of(int tasks, int max_isa)
{
    onespp_config config = {.abi = ONESPP_ABI, .max_width = SIDE, .max_height = SIDE, .max_meshes = MESHES,
                            .tasks = tasks, .max_isa = max_isa, .max_parts = PARTS};
    return config;
}

/* A denoiser in memory that begins anywhere and is filled with NaN. */
static onespp *created(int tasks, int max_isa, uint32_t offset, unsigned char **memory)
{
    onespp_config config = config_of(tasks, max_isa);
    onespp *denoiser;
    size_t size = onespp_size(&config);
    *memory = allocated(size + offset);
    memset(*memory, 0xff, size + offset);
    if (onespp_create(&config, *memory + offset, size, &denoiser))
        abort();
    return denoiser;
}

static void play(Source *source)
{
    size_t room = sizeof(float) * MOST_PIXELS;
    float *planes = allocated(PLANES * room), *one = allocated(OUTPUTS * room), *two = allocated(OUTPUTS * room);
    int32_t *ids = allocated(room);
    double poses[16 * MESHES];
    unsigned char *memory[2];
    int max_isa = (int)draw(source, ONESPP_ISA_AVX512 + 1);
    onespp *denoisers[2] = {created(1, max_isa, draw(source, 65), &memory[0]),
                            created(5, max_isa, draw(source, 65), &memory[1])};
    onespp_config config = config_of(1, max_isa);
    unsigned char *blocks[2], *histories[2], *past = NULL; /* of the second, which is handed them in turn */
    for (int i = 0; i < 2; i++) {
        blocks[i] = allocated(onespp_history_size(&config) + 64);
        histories[i] = blocks[i] + (64 - (uintptr_t)blocks[i] % 64) % 64;
        memset(histories[i], 0xff, onespp_history_size(&config));
    }
    for (int i = 0; i < FRAMES; i++) {
        onespp_frame frame = frame_of(source, planes, ids, poses);
        int pixels = frame.width * frame.height, count = 3 * pixels * (1 + frame.parts);
        onespp_output output = {one, pixels, frame.width, 1}, again = output;
        again.data = two;
        onespp_part parts[2][PARTS];
        for (int part = 0; part < frame.parts; part++) {
            parts[0][part].noisy = parts[1][part].noisy = part ? frame.direct : frame.normal; /* of either sign */
            parts[0][part].radiance = output;
            parts[1][part].radiance = again;
            parts[0][part].radiance.data += 3 * pixels * (part + 1);
            parts[1][part].radiance.data += 3 * pixels * (part + 1);
        }
        frame.part = parts[0];
        int error = onespp_denoise(denoisers[0], &frame, &output);
        frame.part = parts[1];
        if (onespp_denoise_from(denoisers[1], past, histories[i % 2], &frame, &again) != error)
            abort();
        if (error)
            continue;
        past = histories[i % 2];
        for (int k = 0; k < count; k++)
            if (!isfinite(one[k]))
                abort();
        if (memcmp(one, two, sizeof(float) * (size_t)count) != 0)
            abort();
    }
    free(planes);
    free(one);
    free(two);
    free(ids);
    for (int i = 0; i < 2; i++) {
        free(memory[i]);
        free(blocks[i]);
    }
}

int LLVMFuzzerTestOneInput(const uint8_t *bytes, size_t count);

int LLVMFuzzerTestOneInput(const uint8_t *bytes, size_t count)
{
    Source source = {bytes, count, 0, 0};
    for (size_t i = 0; i < count; i++)
        source.state = source.state * 31 + bytes[i];
    play(&source);
    return 0;
}

#ifndef ONESPP_LIBFUZZER
int main(int count, char **arguments)
{
    int sequences = count > 1 ? atoi(arguments[1]) : 100;
    for (int i = 0; i < sequences; i++) {
        Source source = {NULL, 0, 0, (uint64_t)i};
        play(&source);
    }
    printf("%d sequences\n", sequences);
    return 0;
}
#endif
