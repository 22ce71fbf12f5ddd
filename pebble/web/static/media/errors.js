// What is wrong with pictures.

/** A payload is damaged, or none at all: a key frame is wanted. */
export class PayloadError extends Error {}

/** This browser lacks what it takes; a key frame does not help. */
export class UnsupportedError extends Error {}
