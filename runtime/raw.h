/* A frame of a raw sequence, as `python -m runtime.raw` writes it: a header, the poses of its meshes (4 x 4 doubles
 * each) and planes of float32: direct, indirect, emission, albedo and normal (3 channels each), depth, roughness and
 * motion (2); then the mesh ids, of int32. */
#ifndef ONESPP_RAW_H
#define ONESPP_RAW_H

#include "onespp.h"

#include <string.h>

enum { RAW_PLANES = 19 };

typedef struct {
    int32_t width, height, reset, meshes;
    double samples, K[9], camera_to_world[16];
} raw_header;

/* Bytes of a frame, with its header. */
static size_t raw_size(const raw_header *header)
{
    size_t pixels = (size_t)header->width * (size_t)header->height;
    return sizeof *header + sizeof(double) * 16 * (size_t)header->meshes + sizeof(float) * (RAW_PLANES + 1) * pixels;
}

/* Planes one after the other; moves on to what follows them. */
static onespp_image raw_image(const float **planes, const raw_header *header, int channels)
{
    ptrdiff_t size = (ptrdiff_t)header->width * header->height;
    onespp_image result = {*planes, size, header->width, 1};
    *planes += channels * size;
    return result;
}

/* The frame that a header and what follows it describe. */
static onespp_frame raw_frame(const raw_header *header)
{
    const double *poses = (const double *)(header + 1);
    const float *planes = (const float *)(poses + 16 * header->meshes);
    onespp_frame frame = {.width = header->width, .height = header->height, .reset = header->reset};
    frame.samples = (float)header->samples;
    frame.direct = raw_image(&planes, header, 3);
    frame.indirect = raw_image(&planes, header, 3);
    frame.emission = raw_image(&planes, header, 3);
    frame.albedo = raw_image(&planes, header, 3);
    frame.normal = raw_image(&planes, header, 3);
    frame.depth = raw_image(&planes, header, 1);
    frame.roughness = raw_image(&planes, header, 1);
    frame.motion = raw_image(&planes, header, 2);
    onespp_ids ids = {(const int32_t *)planes, header->width, 1};
    frame.mesh_id = ids;
    memcpy(frame.K, header->K, sizeof frame.K);
    memcpy(frame.camera_to_world, header->camera_to_world, sizeof frame.camera_to_world);
    frame.meshes = header->meshes;
    frame.object_to_world = poses;
    return frame;
}

#endif
