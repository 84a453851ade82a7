// Collects the chunks of the page as they arrive, then decompresses and starts the viewer.
const parts = { viewer: [] };

function bytes(base64) {
  const letters = atob(base64);
  const found = new Uint8Array(letters.length);
  for (let i = 0; i < letters.length; i++) found[i] = letters.charCodeAt(i);
  return found;
}

function part(name, base64) {
  (parts[name] ??= []).push(bytes(base64));
  document.currentScript.remove(); // and its text, which is longer than the bytes
  if (!window.file) document.getElementById("progress").value += 1;
}

function failed(reason) {
  console.error(reason);
  const loading = document.getElementById("loading");
  loading.hidden = false;
  loading.classList.add("failure");
  document.getElementById("state").textContent = reason instanceof Error ? reason.message : reason;
}

async function start() {
  if (!document.createElement("canvas").getContext("webgl2"))
    return failed("This browser has no WebGL 2, which the page needs. Turn on hardware acceleration, or use a newer browser.");
  if (!window.DecompressionStream)
    return failed("This browser is too old to decompress the scene. Use a browser from 2023 or later.");
  document.getElementById("state").textContent = "decompressing";
  window.whole = new Promise((resolve) => document.addEventListener("DOMContentLoaded", resolve)); // all chunks are there
  window.file = async (name) => {
    const file = new Blob(parts[name]);
    delete parts[name];
    return new Uint8Array(await file.arrayBuffer());
  };
  const packed = new Blob(parts.viewer).stream().pipeThrough(new DecompressionStream("gzip"));
  const script = document.createElement("script");
  script.textContent = await new Response(packed).text();
  document.getElementById("progress").value += 1;
  window.addEventListener("error", (event) => failed(event.message));
  document.body.append(script);
}
