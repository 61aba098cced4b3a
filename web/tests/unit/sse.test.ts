import { describe, expect, it } from "vitest";
import { EventParser } from "../../src/api/sse";

const STREAM = "id: 3\nevent: snapshot\ndata: {\"a\":1}\nretry: 2000\n\n: heartbeat\n\nid: 4\r\nevent: progress\r\ndata: one\r\ndata: two\r\n\r\nid: 5\ndata:bare\n\n";

describe("the parser of events", () => {
  it("gives the same events wherever the stream is cut", () => {
    const whole = new EventParser().push(STREAM);
    expect(whole).toEqual([
      { type: "snapshot", data: '{"a":1}', id: "3" },
      { type: "progress", data: "one\ntwo", id: "4" },
      { type: "message", data: "bare", id: "5" },
    ]);
    for (let cut = 1; cut < STREAM.length; cut++) {
      const parser = new EventParser();
      expect([...parser.push(STREAM.slice(0, cut)), ...parser.push(STREAM.slice(cut))]).toEqual(whole);
    }
    const parser = new EventParser();
    expect([...STREAM].flatMap((letter) => parser.push(letter))).toEqual(whole);
    expect(parser.retry).toBe(2000);
    expect(parser.lastId).toBe("5");
  });

  it("knows no event before its empty line, and no number from a broken retry", () => {
    const parser = new EventParser();
    expect(parser.push("id: 9\nevent: done\ndata: {}\nretry: soon\n")).toEqual([]);
    expect(parser.retry).toBeNull();
    expect(parser.push("\n")).toHaveLength(1);
    expect(parser.push("event: empty\n\n")).toEqual([]);
  });
});
