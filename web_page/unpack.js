/** The bytes that were deflated. */
async function inflated(base64) {
  const bytes = Uint8Array.from(atob(base64), letter => letter.charCodeAt(0));
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

/** The bytes of 32-bit words that were packed, see __init__.py. */
async function unpacked(base64) {
  const planes = await inflated(base64), count = planes.length / 4, words = new Uint32Array(count);
  for (let i = 0, word = 0; i < count; i++) {
    const step = planes[i] | planes[count + i] << 8 | planes[2 * count + i] << 16 | planes[3 * count + i] << 24;
    words[i] = word = word + step | 0;
  }
  return new Uint8Array(words.buffer);
}
