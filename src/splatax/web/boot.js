// Collects the chunks of the page as they arrive, then decompresses and starts the viewer.
const parts = { viewer: [] };

function part(name, base64) {
  (parts[name] ??= []).push(Uint8Array.from(atob(base64), (letter) => letter.charCodeAt(0)));
  document.getElementById("progress").value += 1;
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
  window.file = async (name) => new Uint8Array(await new Blob(parts[name]).arrayBuffer());
  const packed = new Blob(parts.viewer).stream().pipeThrough(new DecompressionStream("gzip"));
  const script = document.createElement("script");
  script.textContent = await new Response(packed).text();
  document.getElementById("progress").value += 1;
  window.addEventListener("error", (event) => failed(event.message));
  document.body.append(script);
}
