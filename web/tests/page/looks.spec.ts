import { accessible, chooseExample, expect, fits, openPage, showsSurface, submit, test } from "./fixtures";

for (const scheme of ["light", "dark"] as const) {
  test.describe(`on a phone, ${scheme}`, () => {
    test.use({ viewport: { width: 390, height: 844 }, colorScheme: scheme, hasTouch: true });

    test("everything fits and nothing breaks a rule", async ({ page, service }) => {
      await openPage(page, service);
      await fits(page);
      await page.getByText("More options").click();
      await page.getByText("Scene as JSON").first().click();
      await page.getByText("The same job as a program").first().click();
      await fits(page);
      await accessible(page);
      await chooseExample(page, "Star");
      await submit(page);
      await showsSurface(page);
      await fits(page);
      await accessible(page);
      await page.setViewportSize({ width: 320, height: 700 });
      await fits(page);
    });
  });
}

test("colours can be chosen against the system's", async ({ page, service }) => {
  await openPage(page, service);
  const ground = () => page.evaluate(() => getComputedStyle(document.body).backgroundColor);
  const light = await ground();
  await page.getByLabel("Colours").selectOption("dark");
  expect(await ground()).not.toBe(light);
  await accessible(page);
  await page.reload();
  expect(await ground()).not.toBe(light);
});

test.describe("with less motion", () => {
  test.use({ contextOptions: { reducedMotion: "reduce" } });

  test("fronts are shown without being animated", async ({ page, service }) => {
    await openPage(page, service);
    await chooseExample(page, "Vase");
    await submit(page);
    await expect(page.locator(".viewer")).toHaveAttribute("data-fronts", /[1-9]/);
    await showsSurface(page);
  });
});

test("the page is walked through by keys alone", async ({ page, service }) => {
  await openPage(page, service);
  const stops: string[] = [];
  for (let k = 0; k < 40; k++) {
    await page.keyboard.press("Tab");
    const stop = await page.evaluate(() => {
      const at = document.activeElement!;
      return at === document.body ? "end" : (at.getAttribute("aria-label") ?? at.id ?? "") || at.textContent!.trim().slice(0, 30);
    });
    if (stop === "end") break;
    stops.push(stop);
  }
  const inOrder = ["Skip to the surface", "example", "choose a file", "size", "Shrink a sphere onto it"];
  const places = inOrder.map((name) => stops.findIndex((stop) => stop === name));
  expect(places).toEqual([...places].sort((a, b) => a - b));
  expect(Math.min(...places)).toBe(0);
  expect(stops.some((stop) => stop.startsWith("Surface in space"))).toBe(true);
  expect(stops.some((stop) => stop.startsWith("UV square"))).toBe(true);
});
