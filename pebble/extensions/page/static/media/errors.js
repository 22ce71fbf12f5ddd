/** This browser lacks what it takes to decode; a key frame does not help. */
export class UnsupportedError extends Error {}
