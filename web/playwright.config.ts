import { defineConfig } from "@playwright/test";

/** Debian's Chromium, drawing by software, that asks nobody outside for anything. */
const args = [
  "--no-sandbox",
  "--disable-quic",
  "--no-first-run",
  "--disable-background-networking",
  "--disable-component-update",
  "--disable-sync",
  "--use-angle=swiftshader",
  "--enable-unsafe-swiftshader",
  "--ignore-gpu-blocklist",
];
const launch = { executablePath: process.env.CHROMIUM ?? "/usr/bin/chromium" };

export default defineConfig({
  testDir: "tests/page",
  outputDir: "test-results",
  // the service and a browser that draws by software share two cores
  workers: 1,
  timeout: 600_000,
  // generous, since a wait that succeeds ends at once, and the machine may be building something
  expect: { timeout: 180_000 },
  reporter: [["list"]],
  use: { viewport: { width: 1440, height: 1000 }, trace: "off", colorScheme: "light" },
  projects: [
    { name: "webgl", testIgnore: /without-webgl/, use: { launchOptions: { ...launch, args } } },
    { name: "without-webgl", testMatch: /without-webgl/, use: { launchOptions: { ...launch, args: [...args.slice(0, 6), "--disable-gpu", "--disable-3d-apis"] } } },
  ],
});
