// The page: connects the scene, the motions of the camera, and the buttons.
import { Controls } from './controls.js';
import { Hotspots } from './hotspots.js';
import { Glide, Path, Turntable } from './motion.js';
import { Pose } from './pose.js';
import { Stage } from './stage.js';
import { Variants } from './variants.js';

const LONGEST_FRAME = 0.1; // seconds: keeps motion from jumping after a pause
const CALM = matchMedia('(prefers-reduced-motion: reduce)').matches;
const GLIDE = CALM ? 0 : 0.8; // seconds from camera to camera
const find = (id) => document.getElementById(id);
const page = JSON.parse(find('page').textContent);
const cameras = page.cameras.map((camera) => Pose.of(camera));
const path = page.path.map((camera) => Pose.of(camera));
const start = Pose.of(page.start);

class Viewer {
  pose = start.clone();
  motion = null;
  shown = page.start.camera; // index of the current camera; -1 for a free view
  settled = false; // whether the picture is final
  opened = false; // whether there is a picture
  complete = false; // whether the whole scene has been drawn once

  constructor() {
    this.stage = new Stage(find('view'), page);
    this.variants = new Variants(page, (part, visible, color) => this.stage.change(part, visible, color));
    this.hotspots = new Hotspots(find('hotspots'), page.hotspots);
    this.controls = new Controls(find('view'), () => this.#takeOver());
  }

  async open() {
    await this.stage.load(page.parts, window.file);
    performance.mark('loaded');
    this.variants.update();
    if (page.autoplay && !CALM) this.play();
    if (this.stage.animation) this.stage.animation.playing = !CALM;
    update();
    let before = performance.now();
    let idle = 0;
    const frame = (now) => {
      const seconds = Math.min((now - before) / 1000, LONGEST_FRAME);
      const animated = Boolean(this.stage.animation?.advance(seconds));
      const moving = this.#advance(seconds) || animated;
      before = now;
      idle = moving ? 0 : idle + 1;
      this.stage.draw(this.pose, idle < 6);
      this.hotspots.place(this.stage.camera, innerWidth, innerHeight, (part) => this.variants.shows(part));
      this.settled = this.stage.settled && this.stage.complete;
      if (this.stage.opened && !this.opened) this.#begin();
      if (this.stage.parts.whole && find('detail')) find('detail').hidden = true;
      if (this.settled && !this.complete) this.#finish();
      requestAnimationFrame(frame);
    };
    requestAnimationFrame(frame);
  }

  /** Moves to the camera with this index; the first camera follows the last. */
  show(index) {
    this.shown = (index + cameras.length) % cameras.length;
    this.#move(new Glide(this.pose, cameras[this.shown], GLIDE));
  }

  /** Plays or pauses the clip. */
  animate() {
    const { animation } = this.stage;
    if (animation) animation.playing = !animation.playing;
    update();
  }

  reset() {
    this.shown = page.start.camera;
    this.#move(new Glide(this.pose, start, GLIDE));
  }

  play() {
    if (this.playing) return this.#move(null);
    this.shown = -1;
    const [poses, seconds] = path.length > 1 ? [path, page.seconds] : [cameras];
    this.#move(page.play === 'flight' && poses.length > 1 ? new Path(poses, seconds) : new Turntable());
  }

  /** Chooses an option of a variant. */
  choose(variant, option) {
    this.variants.choose(variant, option);
    update();
  }

  get playing() {
    return this.motion instanceof Path || this.motion instanceof Turntable;
  }

  setMode(mode) {
    this.controls.mode = mode;
    update();
  }

  /** Hides the loading screen. On pages with previews, then loads the whole scene; without it, the previews stay. */
  #begin() {
    this.opened = true;
    find('loading').hidden = true;
    performance.mark('opened');
    if (!find('detail')) return;
    window.whole.then(() => this.stage.refine(page.parts, window.file)).catch((error) => {
      console.error(error);
      find('detail').textContent = ' · detail could not be loaded';
    });
  }

  #finish() {
    this.complete = true;
    performance.mark('complete');
  }

  #move(motion) {
    this.controls.stop();
    this.motion = motion;
    update();
  }

  #takeOver() {
    this.motion = null;
    this.shown = -1;
    find('hint').hidden = true;
    update();
  }

  #advance(seconds) {
    if (!this.motion) return this.controls.advance(this.pose, seconds);
    this.pose = this.motion.advance(this.pose, seconds);
    if (this.motion.done) this.motion = null;
    return true;
  }
}

/** Updates the buttons to the state of the viewer. */
function update() {
  find('play').setAttribute('aria-pressed', viewer.playing);
  find('animate')?.setAttribute('aria-pressed', Boolean(viewer.stage.animation?.playing));
  find('mode').setAttribute('aria-pressed', viewer.controls.mode === 'fly');
  find('mode-name').textContent = viewer.controls.mode === 'fly' ? 'Fly' : 'Orbit';
  if (find('cameras')) find('cameras').value = viewer.shown;
  for (const button of options) {
    button.setAttribute('aria-pressed', viewer.variants.chosen[button.dataset.variant] === button.dataset.option);
  }
}

async function enterHeadset() {
  await viewer.stage.enter(await navigator.xr.requestSession('immersive-vr'), viewer.pose);
}

/** Shows a message in the place of the hint. */
function tell(text) {
  const hint = find('hint');
  hint.textContent = text;
  hint.hidden = false;
  hint.classList.add('told');
}

const ACTIONS = {
  previous: () => cameras.length && viewer.show(viewer.shown < 0 ? cameras.length - 1 : viewer.shown - 1),
  next: () => cameras.length && viewer.show(viewer.shown + 1),
  play: () => viewer.play(),
  animate: () => viewer.animate(),
  mode: () => viewer.setMode(viewer.controls.mode === 'fly' ? 'orbit' : 'fly'),
  reset: () => viewer.reset(),
  fullscreen: () => (document.fullscreenElement ? document.exitFullscreen() : document.documentElement.requestFullscreen()),
  headset: () => enterHeadset().catch((error) => tell(`The headset did not start: ${error.message}`)),
  help: () => (find('help-text').open ? find('help-text').close() : find('help-text').showModal()),
  hide: () => document.body.classList.toggle('bare'),
};
const KEYS = {
  ',': 'previous', '.': 'next', ' ': 'play', p: 'animate', o: 'mode', r: 'reset', f: 'fullscreen', '?': 'help', h: 'hide',
}; // prettier-ignore

const options = document.querySelectorAll('#variants button');
const viewer = new Viewer();
for (const button of options) {
  button.addEventListener('click', () => viewer.choose(button.dataset.variant, button.dataset.option));
}
for (const [name, action] of Object.entries(ACTIONS)) {
  find(name)?.addEventListener('click', action);
}
navigator.xr?.isSessionSupported('immersive-vr').then((offered) => (find('headset').hidden = !offered), console.info);
if (!document.fullscreenEnabled) find('fullscreen').hidden = true; // on iPhones
addEventListener('keydown', (event) => {
  const name = KEYS[event.key.toLowerCase()];
  const elsewhere = event.target.closest?.('select') || (event.key === ' ' && event.target.closest?.('button'));
  if (!name || elsewhere || event.ctrlKey || event.metaKey || event.altKey) return;
  if (find('help-text').open && name !== 'help') return;
  event.preventDefault();
  ACTIONS[name]();
});
find('cameras')?.addEventListener('change', (event) => viewer.show(Number(event.target.value)));
find('quality').addEventListener('change', (event) => (viewer.stage.quality = event.target.value));
find('help-text').addEventListener('click', (event) => event.target === find('help-text') && ACTIONS.help());
find('view').addEventListener('webglcontextlost', () => window.failed('The browser lost the graphics device. Reload the page.'));

performance.mark('viewer');
update();
window.viewer = viewer;
viewer.open().catch((error) => window.failed(error));
