// What TypeScript's own libraries do not declare: the names of an AudioWorklet.

declare class AudioWorkletProcessor {
  readonly port: MessagePort;
}

declare const sampleRate: number;
declare const currentTime: number;

declare function registerProcessor(name: string, processor: new () => AudioWorkletProcessor): void;
