/* The runtime in a page: one denoiser, whose frames the page writes into the module's memory one after the other. */
#include "../raw.h"

#define EXPORT(name) __attribute__((export_name(#name))) name

enum { PAGE = 65536 }; /* bytes, the unit in which memory grows */

static onespp *denoiser;
static raw_header *raw;
static float *radiance;

/* Where to write frames of a size, raw.h. NULL where they cannot be denoised or memory is short. To be called once. */
raw_header *EXPORT(create)(int width, int height, int meshes)
{
    onespp_config config = {
        .abi = ONESPP_ABI, .max_width = width, .max_height = height, .max_meshes = meshes, .tasks = 1};
    raw_header header = {.width = width, .height = height, .meshes = meshes};
    size_t size = onespp_size(&config), output = sizeof(float) * 3 * (size_t)width * (size_t)height;
    if (!size)
        return NULL;
    size_t first = __builtin_wasm_memory_grow(0, (raw_size(&header) + output + size) / PAGE + 1);
    if (first == SIZE_MAX)
        return NULL;
    raw = (raw_header *)(first * PAGE);
    radiance = (float *)((unsigned char *)raw + raw_size(&header));
    return onespp_create(&config, radiance + output / sizeof(float), size, &denoiser) ? NULL : raw;
}

/* Denoises the frame that was written; returns 3 planes of radiance, or NULL where the frame is not valid. */
const float *EXPORT(denoise)(void)
{
    onespp_frame frame = raw_frame(raw);
    onespp_output output = {radiance, (ptrdiff_t)frame.width * frame.height, frame.width, 1};
    return onespp_denoise(denoiser, &frame, &output) ? NULL : radiance;
}
