/** Keeps the screen on while that is wanted, where browsers allow it: over https, and while the page can be seen. */

export class Awake {
  /** @param {WakeLock | undefined} locks navigator.wakeLock */
  constructor(locks) {
    this.locks = locks;
    this.wanted = false;
    this.asking = false;
    /** @type {WakeLockSentinel | null} */
    this.lock = null;
  }

  /** To be called again and again: browsers take the lock away when the page is hidden. @param {boolean} wanted */
  async want(wanted) {
    this.wanted = wanted;
    if (!wanted) return this.release();
    if (this.lock?.released === false || this.asking || document.hidden) return;
    this.asking = true;
    try {
      this.lock = (await this.locks?.request("screen")) ?? null;
    } catch {
      this.lock = null; // the battery is low, or the site of a frame does not allow it
    }
    this.asking = false;
    if (!this.wanted) this.release();
  }

  release() {
    this.lock?.release().catch(() => {});
    this.lock = null;
  }
}
