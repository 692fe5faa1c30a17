// The divider between two images: moved by mouse, touch and keyboard (ARIA slider).
import { byId } from './dom.js';

const KEYS = { ArrowLeft: -1, ArrowDown: -1, ArrowRight: 1, ArrowUp: 1, PageDown: -10, PageUp: 10, Home: -100, End: 100 };

export class Swipe {
  /** `moved` is called with the new position, a fraction of the width; `ended` after each movement. */
  constructor(moved, ended) {
    Object.assign(this, { moved, ended, share: 0.5, bar: byId('divider') });
    this.bar.addEventListener('pointerdown', (event) => this.bar.setPointerCapture(event.pointerId));
    this.bar.addEventListener('pointermove', (event) => {
      if (!this.bar.hasPointerCapture(event.pointerId)) return;
      const { left, width } = byId('view').getBoundingClientRect();
      this.set((event.clientX - left) / width);
    });
    this.bar.addEventListener('lostpointercapture', () => this.ended());
    this.bar.addEventListener('keydown', (event) => {
      if (!Object.hasOwn(KEYS, event.key)) return;
      event.preventDefault();
      this.set(this.share + KEYS[event.key] / 100);
      this.ended();
    });
  }

  /** Show the divider between images with these names; null hides the divider. */
  show(names) {
    this.bar.hidden = !names;
    this.names = names;
    this.set(this.share);
  }

  set(share) {
    this.share = Math.min(1, Math.max(0, share));
    const percent = Math.round(100 * this.share);
    this.bar.style.left = `${100 * this.share}%`;
    this.bar.setAttribute('aria-valuenow', percent);
    if (this.names) {
      this.bar.setAttribute('aria-valuetext', `${percent} % ${this.names[0]}, ${100 - percent} % ${this.names[1]}`);
      this.names.forEach((name, index) => {
        byId(['left-caption', 'right-caption'][index]).textContent = name;
      });
    }
    this.moved(this.names ? this.share : 1);
  }
}
