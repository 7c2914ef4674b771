"use strict";
// Denoises the frames of a clip. The first message is the clip; each later one asks for a frame {index, cut}, and is
// answered with that, its pictures before and after as RGBA, the radiance denoised, milliseconds, and PSNR in dB.

// Of a raw frame, raw.h, in bytes.
const HEADER = 224, POSE = 128, RESET = 8;

const DISPLAY_GAMMA = 2.2;

/* UNPACK */

async function open(clip) {
  const { instance } = await WebAssembly.instantiate(await inflated(clip.module));
  instance.exports._initialize();
  const address = instance.exports.create(clip.width, clip.height, clip.meshes);
  if (!address) throw new Error("there is not enough memory for images of this size");
  const frames = await Promise.all(clip.frames.map(async frame => ({
    raw: await unpacked(frame.raw),
    reference: frame.reference && await unpacked(frame.reference),
  })));
  return { ...clip, runtime: instance.exports, address, frames };
}

/** Radiance in planes as displayed: 0 to 255, not rounded, four values a pixel. As datasets/tonemap.py. */
function displayed(radiance, { width, height, exposure }) {
  const pixels = width * height, values = new Float32Array(4 * pixels).fill(255);
  for (let channel = 0; channel < 3; channel++)
    for (let i = 0; i < pixels; i++) {
      const exposed = Math.min(Math.max(exposure * radiance[channel * pixels + i], 0), 1);
      values[4 * i + channel] = 255 * exposed ** (1 / DISPLAY_GAMMA);
    }
  return values;
}

/** In dB; null without a reference. */
function psnr(values, reference) {
  if (!reference) return null;
  let sum = 0; // alpha is the same in both
  for (let i = 0; i < values.length; i++) sum += (values[i] - reference[i]) ** 2;
  const mse = sum / (255 ** 2 * values.length * 3 / 4);
  return mse > 0 ? Math.min(100, -10 * Math.log10(mse)) : 100;
}

/** Radiance in planes: direct + indirect + emission. */
function noisyRadiance(raw, clip) {
  const size = 3 * clip.width * clip.height;
  const [direct, indirect, emission] = [0, 1, 2].map(
    i => new Float32Array(raw.buffer, HEADER + POSE * clip.meshes + 4 * size * i, size));
  return direct.map((value, i) => value + indirect[i] + emission[i]);
}

/** The radiance of a frame in planes, and how long it took. */
function denoised(raw, cut, { runtime, address, width, height }) {
  new Uint8Array(runtime.memory.buffer).set(raw, address);
  new DataView(runtime.memory.buffer).setInt32(address + RESET, cut, true);
  const start = performance.now(), result = runtime.denoise(), milliseconds = performance.now() - start;
  if (!result) throw new Error("a frame is damaged");
  return { radiance: new Float32Array(runtime.memory.buffer, result, 3 * width * height).slice(), milliseconds };
}

function answer(clip, { index, cut }) {
  const { raw, reference } = clip.frames[index];
  const { radiance, milliseconds } = denoised(raw, cut, clip);
  const before = displayed(noisyRadiance(raw, clip), clip), after = displayed(radiance, clip);
  return {
    index, cut, milliseconds, radiance, reference,
    noisy: new Uint8ClampedArray(before), // rounds
    denoised: new Uint8ClampedArray(after),
    psnr: { noisy: psnr(before, reference), denoised: psnr(after, reference) },
  };
}

let clip;
onmessage = async ({ data }) => {
  try {
    if (clip) postMessage(answer(await clip, data));
    else clip = open(data);
    await clip;
  } catch (error) {
    postMessage({ error: error.message });
  }
};
