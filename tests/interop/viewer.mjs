// Shows a splat file in the viewer Spark in headless Chromium, from a camera of ours, and saves what it shows.
// node viewer.mjs MODULES SPLATS CHROMIUM CAMERA_JSON OUT.png

import fs from "node:fs";
import http from "node:http";
import { createRequire } from "node:module";
import path from "node:path";

const [modules, splats, chromium, cameraJson, out] = process.argv.slice(2);
const { chromium: browserType } = createRequire(path.join(modules, "index.js"))("playwright-core");
const camera = JSON.parse(cameraJson);

const page = `<!doctype html><style>body{margin:0;background:#fff}</style>
<script type="importmap">{"imports":{"three":"/three/build/three.module.js","three/addons/":"/three/examples/jsm/",
"@sparkjsdev/spark":"/@sparkjsdev/spark/dist/spark.module.js"}}</script>
<script type="module">
import * as THREE from "three";
import { SparkRenderer, SplatMesh } from "@sparkjsdev/spark";
const c = ${JSON.stringify(camera)};
const renderer = new THREE.WebGLRenderer({ antialias: false, preserveDrawingBuffer: true });
renderer.setPixelRatio(1);
renderer.setSize(c.width, c.height);
renderer.setClearColor(0xffffff, 1);
document.body.appendChild(renderer.domElement);
const scene = new THREE.Scene();
scene.add(new SparkRenderer({ renderer }));
const view = new THREE.PerspectiveCamera(c.fovy, c.width / c.height, 0.01, 100);
view.matrixAutoUpdate = false;
view.matrix.fromArray(c.world.flat()).transpose();
view.matrixWorldNeedsUpdate = true;
const mesh = new SplatMesh({ url: "/splats/" + ${JSON.stringify(path.basename(splats))} });
await mesh.initialized;
scene.add(mesh);
let frames = 0;
renderer.setAnimationLoop(() => { renderer.render(scene, view); window.frames_drawn = ++frames; });
</script>`;

const types = { ".js": "text/javascript", ".wasm": "application/wasm" };
const server = http.createServer((request, response) => {
  const url = decodeURIComponent(request.url.split("?")[0]);
  if (url === "/") {
    response.setHeader("content-type", "text/html");
    response.end(page);
    return;
  }
  const file = url.startsWith("/splats/") ? splats : path.join(modules, url);
  if (!fs.existsSync(file)) {
    response.statusCode = 404;
    response.end();
    return;
  }
  response.setHeader("content-type", types[path.extname(file)] ?? "application/octet-stream");
  response.end(fs.readFileSync(file));
});
await new Promise((resolve) => server.listen(0, "127.0.0.1", resolve));

const browser = await browserType.launch({
  executablePath: chromium,
  args: ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"],
});
const tab = await browser.newPage({ viewport: { width: camera.width, height: camera.height } });
const problems = [];
tab.on("pageerror", (error) => problems.push(String(error)));
tab.on("console", (line) => line.type() === "error" && problems.push(line.text()));
try {
  await tab.goto(`http://127.0.0.1:${server.address().port}/`);
  await tab.waitForFunction("window.frames_drawn > 30", null, { timeout: 60000 });
  await tab.screenshot({ path: out });
} catch (error) {
  console.error(error, problems.join("\n"));
  process.exitCode = 1;
}
await browser.close();
server.close();
