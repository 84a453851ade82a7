// Gathers the parts of the page as they arrive, then unpacks and starts the viewer.
const parts = { viewer: [], scene: [] };

function part(name, base64) {
  parts[name].push(Uint8Array.from(atob(base64), (letter) => letter.charCodeAt(0)));
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
    return failed("This browser cannot draw in 3D: it has no WebGL 2. Switch on hardware acceleration, or use a newer browser.");
  if (!window.DecompressionStream)
    return failed("This browser is too old to unpack the scene. Use one of 2023 or later.");
  document.getElementById("state").textContent = "unpacking";
  window.scene = new Blob(parts.scene).arrayBuffer().then((buffer) => new Uint8Array(buffer));
  const packed = new Blob(parts.viewer).stream().pipeThrough(new DecompressionStream("gzip"));
  const script = document.createElement("script");
  script.textContent = await new Response(packed).text();
  document.getElementById("progress").value += 1;
  window.addEventListener("error", (event) => failed(event.message));
  document.body.append(script);
}
