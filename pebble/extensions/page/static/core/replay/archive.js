/** The recordings of the server, as its /archive/ offers them. No framework, no DOM. */

import { ROOT } from "../browser.js";

const INDEXING_MS = 500; // between two questions for a day that is being indexed

/**
 * @typedef {{since: number, until: number, why?: string}} Stretch
 * @typedef {{from: number, step: number, activity: number[], gaps: Stretch[], outages: Stretch[], sessions: Stretch[]}} Timeline
 * @typedef {{day: string, robots: string[], bytes: number, first: number, last: number, gaps: number, unread: string[],
 *   driven?: Record<string, number>}} Day ``driven``: seconds by robot
 * @typedef {{state: "running" | "ready" | "failed", done: number, why: string, name: string, bytes: number}} ExportState
 */

export class Archive {
  /** @param {(url: string, options?: any) => Promise<Response>} [ask] fetch */
  constructor(ask = (url, options) => fetch(url, options)) {
    this.ask = ask;
  }

  /** @param {AbortSignal} [signal] @returns {Promise<Day[]>} newest first */
  async days(signal) {
    return (await this.get(`${ROOT}archive/days`, signal)).json();
  }

  /**
   * Waits while the day is being indexed. ``again``: also if that has failed before.
   * @param {string} day @param {string} robot @param {(share: number) => void} onIndexing @param {AbortSignal} signal
   * @param {boolean} [again]
   * @returns {Promise<Timeline>}
   */
  async timeline(day, robot, onIndexing, signal, again = false) {
    for (;; again = false) {
      const asked = new URLSearchParams({ day, robot, ...(again && { again: "1" }) });
      const answer = await this.get(`${ROOT}archive/timeline?${asked}`, signal);
      const value = await answer.json();
      if (answer.status !== 202) return value;
      onIndexing(value.indexing ?? 0);
      await delay(INDEXING_MS, signal);
    }
  }

  /** @param {string} robot @param {Stretch} stretch @param {"mkv" | "mp4" | "mcap"} as @returns {Promise<string>} its id */
  async begin(robot, { since, until }, as) {
    const body = { robot, since: Math.floor(since), until: Math.ceil(until), as };
    return (await (await this.post(`${ROOT}archive/exports`, body)).json()).id;
  }

  /** @param {string} id @param {AbortSignal} signal @returns {Promise<ExportState>} */
  async progress(id, signal) {
    return (await this.get(`${ROOT}archive/exports/${encodeURIComponent(id)}`, signal)).json();
  }

  /** Ends an export, or removes what it has made. @param {string} id */
  async end(id) {
    await this.post(`${ROOT}archive/exports/${encodeURIComponent(id)}/end`, {});
  }

  /** @param {string} id @returns {string} the address of its file */
  static file(id) {
    return `${ROOT}archive/exports/${encodeURIComponent(id)}/file`;
  }

  /** @param {string} url @param {AbortSignal} [signal] */
  async get(url, signal) {
    return checked(await this.ask(url, { signal }));
  }

  /** @param {string} url @param {any} body */
  async post(url, body) {
    const headers = { "content-type": "application/json" };
    return checked(await this.ask(url, { method: "POST", headers, body: JSON.stringify(body) }));
  }
}

/** @param {Response} answer */
async function checked(answer) {
  if (answer.ok) return answer;
  if (answer.status === 401) throw new Error("log in again: the session has ended");
  const line = (await answer.text()).split("\n")[0].slice(0, 300);
  throw new Error(line || `the server ${answer.status < 500 ? "refuses" : "failed"} (${answer.status})`);
}

/** @param {number} ms @param {AbortSignal} signal */
export function delay(ms, signal) {
  signal.throwIfAborted();
  return new Promise((resolve, reject) => {
    const timer = setTimeout(() => resolve(undefined), ms);
    signal.addEventListener("abort", () => {
      clearTimeout(timer);
      reject(signal.reason);
    });
  });
}
