/* onespp.h - the denoiser `one` in C99: noisy radiance of a few samples per pixel in, smooth radiance out, frame by
 * frame.
 *
 * All memory is the caller's: ask for its size, hand it over once, and free it when done. Nothing else is allocated,
 * and there is no global state: any number of denoisers can run at the same time, each called by one thread at a time.
 *
 * Images have any layout that strides describe. A number that is NaN or infinite counts as 0.
 */
#ifndef ONESPP_H
#define ONESPP_H

#include <stddef.h>
#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

#define ONESPP_ABI 4 /* changes whenever a program has to be compiled anew */

enum {
    ONESPP_OK = 0,
    ONESPP_BAD_ABI = 1,    /* the program was compiled with another version of this header */
    ONESPP_BAD_CONFIG = 2, /* a size or number of tasks is out of range */
    ONESPP_BAD_MEMORY = 3, /* the memory is NULL or smaller than onespp_size returns; a history is not aligned */
    ONESPP_BAD_FRAME = 4,  /* a size, a number of samples, or a required image is missing or out of range */
    ONESPP_BAD_CAMERA = 5  /* a camera's number is not finite, or its focal length is 0 */
};

#define ONESPP_MAX_SIDE 16384   /* pixels */
#define ONESPP_MAX_MESHES 65536 /* that move */
#define ONESPP_MAX_TASKS 1024
#define ONESPP_MAX_PARTS 16 /* of the light */
#define ONESPP_HISTORY 13   /* channels of a history */
#define ONESPP_MIN_SAMPLES 1e-3f
#define ONESPP_MAX_SAMPLES 1e9f

/* Instruction sets, in order. Results of two of them differ by rounding errors. */
enum {
    ONESPP_ISA_ANY = 0,      /* the fastest that there is */
    ONESPP_ISA_BASELINE = 1, /* that of the compiler's flags */
    ONESPP_ISA_AVX2 = 2,     /* with FMA */
    ONESPP_ISA_AVX512 = 3    /* F, BW, DQ and VL */
};

/* An image of floats: pixel (x, y) of a channel is data[channel * c + row * y + column * x]. Planes of W x H pixels
 * have the strides {W * H, W, 1}, interleaved pixels of three channels {1, 3 * W, 3}; strides of 0 repeat one value. */
typedef struct {
    const float *data;
    ptrdiff_t channel, row, column;
} onespp_image;

typedef struct {
    float *data;
    ptrdiff_t channel, row, column;
} onespp_output;

typedef struct {
    const int32_t *data;
    ptrdiff_t row, column;
} onespp_ids;

/* A part of the light, such as that of one lamp: it is denoised by the kernels that are chosen for the whole, so parts
 * whose noisy radiance adds up to `direct` plus `indirect` do so denoised. Its past is scaled by changes of the whole;
 * that of a mask is not, which stays between 0 and 1. Background stays as it is. */
typedef struct {
    onespp_image noisy;     /* 3 channels of radiance, of either sign */
    onespp_output radiance; /* 3; may be the noisy image itself, and overlap no other input */
} onespp_part;

/* One frame. Radiance is linear RGB in any unit; lengths are in any unit, always the same. Matrices are row by row.
 *
 * Camera space has x to the left, y up and z forward. With p a point in camera space, pixel = (K p) / p_z, where x goes
 * right, y down, and the centre of the first pixel is (0.5, 0.5): so K[0] and K[4], the focal lengths in pixels, are
 * negative. From cameras with x to the right, negate these columns of camera_to_world: of OpenCV's the first two (y
 * down, z forward), of OpenGL's the first and the third (y up, z backward).
 *
 * Images marked optional may have data = NULL. Albedo, roughness and normals count as at most 100. */
typedef struct {
    int width, height; /* at most those of onespp_config; another size than before resets */
    int reset;         /* 1 for the first frame and after a cut: forget everything before */
    float samples;     /* per pixel, in the light below; 1 where unknown */

    onespp_image direct;    /* 3 channels: noisy radiance after one bounce, or the sum of both kinds of light. Of
                             * surfaces: background shows its emission alone */
    onespp_image indirect;  /* 3, optional: noisy radiance after more bounces, added to `direct` */
    onespp_image emission;  /* 3, optional: light sources seen directly, free of noise; added to the output */
    onespp_image albedo;    /* 3: reflectance in [0, 1] that both kinds of light contain; 1 for background */
    onespp_image normal;    /* 3: shading normal in world space, of length 1, towards the viewer; 0 for background */
    onespp_image depth;     /* 1: distance along the viewing axis; 0 for background */
    onespp_image roughness; /* 1, optional: GGX alpha; 1 for diffuse surfaces and background */
    onespp_image motion;    /* 2: x and y from the pixel to where its surface was in the previous frame, in pixels */
    onespp_ids mesh_id;     /* optional: number of the mesh from 1 on; 0 for background. By default one for all. Meshes
                             * described as mirrors and glass show them need numbers of their own there */

    double K[9];                   /* intrinsics; of these the focal lengths and the centre are used */
    double camera_to_world[16];    /* rigid */
    int meshes;                    /* at most max_meshes */
    const double *object_to_world; /* meshes x 16, rigid, entry mesh_id - 1; NULL for 0 meshes. Others do not move */

    int parts; /* at most max_parts; another number than before resets */
    const onespp_part *part;
    int masks; /* how many parts, the last ones, are no light but masks: their past is not scaled */
} onespp_frame;

/* Calls task(argument, i) once for each i from 0 to count - 1, in any order and on any threads, and returns when all
 * have returned. */
typedef void (*onespp_task)(void *argument, int index);
typedef void (*onespp_parallel_for)(void *user, int count, onespp_task task, void *argument);

typedef struct {
    int abi;                          /* ONESPP_ABI */
    int max_width, max_height;        /* of frames */
    int max_meshes;                   /* with an object_to_world, per frame; 0 where nothing but the camera moves */
    int tasks;                        /* that each step is split into: 1, or at least as many as there are threads */
    onespp_parallel_for parallel_for; /* NULL: tasks run one after the other */
    void *user;                       /* handed to parallel_for */
    int max_isa;                      /* use no instruction set above this one; 0 for the fastest */
    int max_parts;                    /* of the light, per frame; 0 where only the whole is denoised */
} onespp_config;

typedef struct onespp onespp;

/* The ABI of the library: ONESPP_ABI of the header that it was compiled with. */
int onespp_abi(void);

/* How many bytes of memory a denoiser needs; 0 where the configuration is not valid. */
size_t onespp_size(const onespp_config *config);

/* Sets *denoiser up in `size` bytes of `memory`, which it uses until the caller frees or reuses them. */
int onespp_create(const onespp_config *config, void *memory, size_t size, onespp **denoiser);

/* The same with other weights than those compiled in: `count` of them, in the order of onespp_weights.h. */
int onespp_create_with(
    const onespp_config *config, void *memory, size_t size, const float *weights, size_t count, onespp **denoiser);

/* Denoises one frame: writes 3 channels of radiance. The result does not depend on tasks and threads. The output may
 * overlap no input. After an error nothing was written, and the state is what it was. */
int onespp_denoise(onespp *denoiser, const onespp_frame *frame, const onespp_output *radiance);

/* --- Histories as values ---
 *
 * A denoiser keeps the history of one sequence by itself. With the following calls it serves several, such as the views
 * of a scene, and can go back to an earlier frame: what a frame leaves is in the caller's memory, which may be copied. */

/* How many bytes a history takes; 0 where the configuration is not valid. */
size_t onespp_history_size(const onespp_config *config);

/* onespp_denoise for a frame that follows the history `past`, or none where that is NULL. Its own is written to `next`,
 * which may be `past`. Both begin at multiples of 64 bytes, else ONESPP_BAD_MEMORY. A history fits denoisers of the same
 * max_width, max_height and max_parts; a frame of another size or number of parts begins anew after any. */
int onespp_denoise_from(
    onespp *denoiser, const void *past, void *next, const onespp_frame *frame, const onespp_output *radiance);

/* Writes ONESPP_HISTORY channels of a history: denoised and accumulated irradiance (3 each), the latter's effective
 * length in samples, and 6 that the network carries. */
void onespp_read_history(const onespp *denoiser, const void *history, const onespp_output *to);

/* The instruction set that it uses. */
int onespp_isa(const onespp *denoiser);

/* A code in words, in English. */
const char *onespp_message(int code);

#ifdef __cplusplus
}
#endif

#endif
