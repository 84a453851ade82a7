// Notes at places of the scene: buttons that follow the view, and show their text when pressed.
import { Vector3 } from 'three';

const MARGIN = 15; // pixels, of a button to the left of and above its place

export class Hotspots {
  #notes;

  constructor(parent, hotspots) {
    this.#notes = hotspots.map(({ at, text, part }, i) => {
      const button = document.createElement('button');
      button.className = 'hotspot';
      button.setAttribute('aria-expanded', 'false');
      button.setAttribute('aria-label', text);
      const number = document.createElement('b');
      number.textContent = i + 1;
      const note = document.createElement('span');
      note.textContent = text;
      button.append(number, note);
      button.addEventListener('click', () => {
        button.setAttribute('aria-expanded', button.getAttribute('aria-expanded') !== 'true');
      });
      parent.append(button);
      return { button, part, at: new Vector3(...at) };
    });
  }

  /**
   * Moves the buttons to where the camera sees their places; `shows` tells whether a part is visible. Open notes are
   * kept inside the window.
   */
  place(camera, width, height, shows) {
    for (const { button, part, at } of this.#notes) {
      const seen = at.clone().applyMatrix4(camera.matrixWorldInverse);
      button.hidden = seen.z > -camera.near || (part >= 0 && !shows(part));
      if (button.hidden) continue;
      const place = seen.applyMatrix4(camera.projectionMatrix);
      let [x, y] = [((place.x + 1) / 2) * width, ((1 - place.y) / 2) * height];
      if (button.getAttribute('aria-expanded') === 'true') {
        x = Math.max(MARGIN, Math.min(x, width + MARGIN - button.offsetWidth));
        y = Math.max(MARGIN, Math.min(y, height + MARGIN - button.offsetHeight));
      }
      button.style.transform = `translate(${x}px, ${y}px)`;
    }
  }
}
