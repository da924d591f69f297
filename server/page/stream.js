// The connection to the service: server-sent events, read with fetch(), which can send a key.
// It opens anew for ever; what it says about itself is the caller's to show.

const FIRST_WAIT = 300; // until the first attempt after a loss [ms]
const LONGEST_WAIT = 3000;

export class Stream {
  #hear;
  #control = new AbortController();
  #wait = FIRST_WAIT;

  /** The read key, or null: none is needed, or none is known. */
  key = null;

  /**
   * @param hear  {about(data), update(data), lost(why), refused()}: what the service is, an update,
   *              that the connection was lost, that it asks for a key (then `look` must be called again).
   */
  constructor(hear) {
    this.#hear = hear;
  }

  /** Opens the stream that shows this robot (null: the first), in place of the one before. */
  look(robot) {
    this.#control.abort();
    this.#control = new AbortController();
    this.#wait = FIRST_WAIT;
    this.#run(robot, this.#control.signal);
  }

  async #run(robot, signal) {
    while (!signal.aborted) {
      let why = "the service ended the stream";
      try {
        why = (await this.#listen(robot, signal)) ?? why;
      } catch {
        why = "the service does not answer";
      }
      if (signal.aborted || why === "key") return;
      this.#hear.lost(why);
      await new Promise((done) => setTimeout(done, this.#wait));
      this.#wait = Math.min(2 * this.#wait, LONGEST_WAIT);
    }
  }

  /** Reads one stream to its end; why it could not be read. */
  async #listen(robot, signal) {
    const query = robot === null ? "" : `?robot=${encodeURIComponent(robot)}`;
    const headers = this.key === null ? {} : { authorization: `Bearer ${this.key}` };
    const reply = await fetch(`live${query}`, { headers, signal, cache: "no-store" });
    if (reply.status === 401 || reply.status === 403) {
      this.#hear.refused();
      return "key";
    }
    if (!reply.ok) return reply.status === 503 ? "the service takes no more watchers" : `status ${reply.status}`;
    const reader = reply.body.pipeThrough(new TextDecoderStream()).getReader();
    let left = "";
    for (;;) {
      const { value, done } = await reader.read();
      if (done || signal.aborted) return null;
      const events = (left + value).split("\n\n");
      left = events.pop();
      for (const event of events) this.#tell(event);
    }
  }

  #tell(event) {
    const lines = event.split("\n");
    const data = lines.find((line) => line.startsWith("data: "));
    if (data === undefined) return;
    this.#wait = FIRST_WAIT;
    const told = JSON.parse(data.slice(6));
    if (lines.includes("event: about")) this.#hear.about(told);
    else this.#hear.update(told);
  }
}
