import { accessible, changes, chooseExample, chartPicture, expect, openPage, seen, showsSurface, submit, surfacePicture, test } from "./fixtures";

test("without WebGL the same page draws on a canvas: watch, turn, modes and pointing", async ({ page, service }) => {
  expect(await page.evaluate(() => document.createElement("canvas").getContext("webgl2"))).toBeNull();
  await openPage(page, service);
  await expect(page.locator(".space .viewport")).toHaveAttribute("data-renderer", "Canvas 2D");
  const ball = await seen(surfacePicture(page));
  await chooseExample(page, "Bracket");
  await submit(page);
  await expect(page.locator(".viewer")).toHaveAttribute("data-fronts", /[1-9]/);
  await showsSurface(page);
  let last = await changes(surfacePicture(page), ball);
  await page.getByRole("application", { name: /Surface in space/ }).focus();
  await page.keyboard.press("ArrowUp");
  last = await changes(surfacePicture(page), last);
  for (const mode of ["UV grid", "Normals", "Area distortion", "Wireframe"]) {
    await page.getByRole("radio", { name: mode }).check({ force: true });
    last = await changes(surfacePicture(page), last);
  }
  await chartPicture(page).hover({ position: { x: 150, y: 220 } });
  await expect(page.locator(".space .overlay circle")).toHaveCount(2);
  await accessible(page);
});
