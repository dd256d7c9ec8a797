function startLive() {
  throw new Error("no stream yet");
}
