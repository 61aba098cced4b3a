import { defineConfig } from "vitest/config";

/** Where the service is that `npm run dev` and `npm run preview` speak to. */
const service = process.env.SHRINKD_URL ?? "http://127.0.0.1:8080";
const proxy = Object.fromEntries(
  ["/v1", "/docs", "/openapi.json", "/livez", "/readyz"].map((path) => [path, { target: service }]),
);

export default defineConfig({
  // everything but index.html lies under assets/, as the program serves it
  publicDir: false,
  build: { assetsDir: "assets", assetsInlineLimit: 0, target: "es2022", modulePreload: { polyfill: false } },
  server: { proxy, fs: { allow: [".."] } },
  preview: { proxy },
  test: { include: ["tests/unit/**/*.test.ts"] },
});
